"""Pages of a service that has users: sign-in by token and provider, users, status, and the page of the API."""

import re

from pytest import fixture, mark

from ground_service.access.service import add_user, list_tokens, list_users
from ground_service.ground import open_ground
from tests.ground_service.access.openid import CLIENT, SECRET, running_provider
from tests.ground_service.web.conftest import patient, strict_page
from tests.lazy import expect
from tests.serving import token_valid


@fixture(scope="module")
def guarded(tmp_path_factory, console, serve):
    """A service with one viewer; its address and the viewer's token."""
    home = tmp_path_factory.mktemp("guarded") / "home"
    with open_ground(home) as ground:
        token = add_user(ground, "ada", "viewer")
    with serve(home, console.port) as running:
        yield running.url, token


@fixture
def stranger(browser, guarded):
    """A page of somebody who has not signed in."""
    context = patient(browser.new_context(base_url=guarded[0]))
    opened = context.new_page()
    yield opened
    context.close()


def asks(page):
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()


def sign_in(page, token):
    page.get_by_label("Token", exact=True).fill(token)
    page.locator("dialog").get_by_role("button", name="Sign in").click()


def test_a_stranger_is_asked_for_a_token_and_a_wrong_one_is_no_use(stranger):
    stranger.goto("/")
    asks(stranger)
    sign_in(stranger, "not-a-token")
    asks(stranger)
    expect(stranger.locator("#feed-light")).not_to_have_class("light on")


def test_a_viewer_sees_and_may_not_command(stranger, guarded):
    stranger.goto("/commands")
    sign_in(stranger, guarded[1])
    expect(stranger.locator("#feed-light")).to_have_class("light on")
    expect(stranger.locator("#caller")).to_have_text("Sign out")
    expect(stranger.locator("#user")).to_have_text("ada, viewer")
    expect(stranger.get_by_role("button", name="Queue")).to_be_hidden()
    other = stranger.context.new_page()  # one sign-in for all tabs
    other.goto("/alarms")
    expect(other.locator("#user")).to_have_text("ada, viewer")
    stranger.locator("#caller").click()
    asks(stranger)


def test_a_viewer_may_not_steer_the_payload(stranger, guarded, console):
    stranger.goto("/live")
    sign_in(stranger, guarded[1])
    expect(stranger.locator("#state")).to_have_text("connected")
    console.received.clear()
    expect(stranger.get_by_role("button", name="Pause")).to_be_hidden()
    stranger.locator("#pause").dispatch_event("click")  # a viewer who does not use the page
    expect(stranger.locator("#state")).to_contain_text("operator")
    assert console.received == []


@mark.parametrize("address", ["/reports/{key}#part", "/?next=/reports/{key}%23part"])
def test_the_part_of_a_page_in_the_address_is_kept_over_the_sign_in(stranger, guarded, address):
    stranger.goto(address.format(key="0" * 32))
    asks(stranger)
    sign_in(stranger, guarded[1])
    expect(stranger).to_have_url(f"{guarded[0]}/reports/{'0' * 32}#part")
    expect(stranger.locator("body")).to_contain_text("not found")


@mark.parametrize("next_page", ["//example.org/", "/%5Cexample.org/", "https://example.org/"])
def test_after_sign_in_no_other_host_is_opened(stranger, guarded, next_page):
    stranger.goto(f"/?next={next_page}")
    sign_in(stranger, guarded[1])
    expect(stranger.locator("#user")).to_have_text("ada, viewer")
    assert stranger.url.startswith(guarded[0])


def test_the_sign_in_is_used_with_the_keyboard(stranger, guarded):
    stranger.goto("/licences")
    dialog = stranger.get_by_role("dialog", name="Sign in")
    expect(stranger.get_by_label("Token")).to_be_focused()
    visited = []
    for _ in range(8):
        stranger.keyboard.press("Tab")
        visited.append(stranger.evaluate("document.activeElement.closest('dialog, main, header, footer')?.id"))
    assert "sign-in" in visited and set(visited) <= {"sign-in", None}  # None: controls of the browser
    stranger.keyboard.press("Escape")
    expect(dialog).to_be_hidden()
    stranger.locator("#caller").press("Enter")
    expect(stranger.get_by_label("Token")).to_be_focused()
    stranger.keyboard.press("Escape")
    expect(stranger.locator("#caller")).to_be_focused()
    stranger.keyboard.press("Enter")
    stranger.keyboard.type(guarded[1])
    stranger.keyboard.press("Enter")
    expect(stranger.locator("#user")).to_have_text("ada, viewer")


@fixture(scope="module")
def provider():
    with running_provider() as running:
        running.claims["roles"] = ["linna-admins"]
        yield running


@fixture(scope="module")
def signed_in_elsewhere(tmp_path_factory, serve, console, provider):
    """The address of a service whose users sign in with the provider."""
    home = tmp_path_factory.mktemp("openid") / "home"
    home.mkdir()
    (home.parent / "secret").write_text(SECRET)
    settings = {
        "LINNA_OIDC_ISSUER": provider.issuer, "LINNA_OIDC_CLIENT_ID": CLIENT,
        "LINNA_OIDC_CLIENT_SECRET_FILE": str(home.parent / "secret"), "LINNA_OIDC_ROLES": "admin=linna-admins",
    }  # fmt: skip
    with serve(home, console.port, settings=settings) as running:
        yield running.url.replace("127.0.0.1", "localhost")


def test_a_user_comes_back_signed_in_to_the_page_and_signs_out_everywhere(browser, signed_in_elsewhere, provider):
    """The session cookie is strict: a redirect from the provider to the page would come without it."""
    url = signed_in_elsewhere
    assert "localhost" in url and "127.0.0.1" in provider.issuer
    context = patient(browser.new_context(base_url=url))
    page = context.new_page()
    page.goto("/users?offset=0#tokens")
    asks(page)
    page.get_by_role("link", name="Sign in with the account of your organisation").click()
    expect(page).to_have_url(f"{url}/users?offset=0#tokens")
    expect(page.locator("#user")).to_have_text("ann, admin")
    expect(page.locator("#user")).to_have_attribute("title", re.compile(r"The session ends \d{4}-.* UTC"))
    row = page.locator("#users").get_by_role("row").filter(has_text="ann")
    expect(row).to_contain_text(provider.issuer)
    expect(page.locator("#tokens")).to_contain_text("browser session by the provider")
    assert page.get_by_label("role of ann").count() == 0
    page.locator("#caller").click()
    page.wait_for_url(f"{provider.issuer}/end?*")
    page.goto(f"{url}/users")
    asks(page)
    context.close()


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
    with serve(tmp_path / "home", console.port) as running, strict_page(browser, running.url, strict=False) as page:
        page.goto("/licences")
        sign_in(page, token)
        expect(page.locator("#user")).to_have_text("ann, viewer")
        page.goto("/docs")
        page.locator("#operations-passes-list_passes .opblock-summary-control").click()
        page.locator("#operations-passes-list_passes .try-out__btn").click()
        with page.expect_response("**/api/v1/passes*") as answered:
            page.locator("#operations-passes-list_passes .execute").click()
        assert answered.value.status == 200


@fixture(scope="module")
def managed(tmp_path_factory, serve, console):
    """A service with an administrator and a viewer: address, home folder, token of the administrator."""
    home = tmp_path_factory.mktemp("managed") / "home"
    with open_ground(home) as ground:
        token = add_user(ground, "ann", "admin")
        add_user(ground, "vic", "viewer")
    with serve(home, console.port) as running:
        yield running.url, home, token


@fixture
def admin(browser, managed):
    """The page of users, of an administrator who has signed in."""
    context = patient(browser.new_context(base_url=managed[0]))
    page = context.new_page()
    page.goto("/users")
    sign_in(page, managed[2])
    expect(page.get_by_role("button", name="Disable vic")).to_be_visible()
    yield page
    context.close()


def test_a_user_is_added_and_the_token_shown_once(admin, managed):
    admin.get_by_label("Name").fill("ola")
    admin.locator("#role").select_option("operator")
    admin.get_by_label("Missions", exact=True).fill("selenita, other")
    admin.get_by_label("Days valid").fill("7")
    admin.get_by_role("button", name="Add user").click()
    shown = admin.locator("#given code")
    expect(shown).to_be_visible()
    token = shown.inner_text()
    with open_ground(managed[1]) as ground:
        assert token_valid(ground, token)
        (found,) = [one for one in list_tokens(ground) if one.user == "ola"]
        assert found.expires is not None and 6.9 < (found.expires.utc_ns - found.created.utc_ns) / 86_400e9 < 7.1
        assert {one.name: one.missions for one in list_users(ground)} == {
            "ann": None, "vic": None, "ola": ["selenita", "other"],
        }  # fmt: skip
    cells = admin.locator("#users tbody tr").filter(has_text="ola").locator("td")
    expect(cells.nth(2)).to_have_text("selenita, other")
    expect(admin.locator("#users tbody tr").filter(has_text="vic").locator("td").nth(2)).to_have_text("all")
    admin.get_by_role("button", name="Hide").click()
    expect(shown).to_be_hidden()
    admin.reload()
    expect(admin.get_by_role("button", name="Disable ola")).to_be_visible()
    assert token not in admin.content()


def test_a_user_is_disabled_enabled_and_given_another_role(admin, managed):
    admin.get_by_role("button", name="Disable vic").click()
    expect(admin.get_by_role("button", name="Enable vic")).to_be_visible()
    admin.get_by_role("button", name="Enable vic").click()
    expect(admin.get_by_role("button", name="Disable vic")).to_be_visible()
    admin.get_by_label("role of vic").select_option("operator")
    expect(admin.locator("#notices")).to_contain_text("vic is operator now.")
    with open_ground(managed[1]) as ground:
        assert {one.name: (one.role, one.state) for one in list_users(ground)}["vic"] == ("operator", "active")


def test_a_token_is_revoked(admin, managed):
    admin.get_by_role("button", name="New token for vic").click()
    expect(admin.locator("#given code")).to_be_visible()
    token = admin.locator("#given code").inner_text()
    row = admin.get_by_role("row").filter(has_text=token[:12])
    row.get_by_role("button", name="Revoke").click()
    expect(row).to_contain_text("revoked")
    with open_ground(managed[1]) as ground:
        assert not token_valid(ground, token)


def test_the_status_states_what_is_known_and_what_is_not(admin):
    admin.goto("/status")
    row = admin.get_by_role("row").filter(has_text="Newest backup")
    expect(row).to_contain_text("unknown")
    expect(admin.locator("#correlations")).to_contain_text("No time correlation.")
    expect(admin.get_by_role("row").filter(has_text="Free disk space")).to_contain_text("GiB")
    # The server gets the lease of the recurring work some seconds after its start; the page asks again.
    expect(admin.get_by_role("row").filter(has_text="Recurring work is done by")).not_to_contain_text("no process")
    expect(admin.locator("#complaints")).to_contain_text("No backup is known.")
    for text in ("No process does the recurring work.", "The newest backup is"):
        expect(admin.locator("#complaints")).not_to_contain_text(text)
