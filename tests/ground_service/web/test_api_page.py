"""The API page in Chromium: operations are shown and called under the content security policy."""

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from tests.ground_service.web.conftest import strict_page
from tests.lazy import expect


def test_the_api_page_shows_and_calls_operations_without_console_errors(page):
    said = []
    page.on("console", lambda message: said.append(message.text) if message.type == "error" else None)
    page.set_viewport_size({"width": 1280, "height": 16_000})  # what comes into view is drawn
    page.goto("/docs")
    described = page.request.get("/api/v1/openapi.json").json()["paths"]
    expect(page.locator(".opblock")).to_have_count(sum(len(methods) for methods in described.values()))
    page.locator("#operations-passes-list_passes .opblock-summary-control").click()
    page.locator("#operations-passes-list_passes .try-out__btn").click()
    page.locator("#operations-passes-list_passes .execute").click()
    answer = page.locator("#operations-passes-list_passes .live-responses-table .response-col_status").last
    expect(answer).to_contain_text("200")
    assert said == []


def test_the_api_page_uses_the_session_of_the_signed_in_user(browser, serve, console, tmp_path):
    with open_ground(tmp_path / "home") as ground:
        token = add_user(ground, "ann", "viewer")
    with (
        serve(tmp_path / "home", console.port) as running,
        strict_page(browser, running.url, strict=False) as page,
    ):
        page.goto("/licences")
        page.get_by_label("Token").fill(token)
        page.locator("dialog").get_by_role("button", name="Sign in").click()
        expect(page.locator("#user")).to_have_text("ann, viewer")
        page.goto("/docs")
        page.locator("#operations-passes-list_passes .opblock-summary-control").click()
        page.locator("#operations-passes-list_passes .try-out__btn").click()
        with page.expect_response("**/api/v1/passes*") as answered:
            page.locator("#operations-passes-list_passes .execute").click()
        assert answered.value.status == 200
