"""Pages of a service that has users."""

import pytest

from ground_service.access.service import add_user
from ground_service.ground import open_ground
from tests.ground_service.web.conftest import patient
from tests.lazy import expect


@pytest.fixture(scope="module")
def guarded(tmp_path_factory, console, serve):
    """A service with one viewer; its address and the viewer's token."""
    home = tmp_path_factory.mktemp("guarded") / "home"
    with open_ground(home) as ground:
        token = add_user(ground, "ada", "viewer")
    with serve(home, console.port) as running:
        yield running.url, token


@pytest.fixture
def stranger(browser, guarded):
    """A page of somebody who has not signed in."""
    context = patient(browser.new_context(base_url=guarded[0]))
    opened = context.new_page()
    yield opened
    context.close()


def sign_in(page, token):
    page.get_by_label("Token").fill(token)
    page.locator("dialog").get_by_role("button", name="Sign in").click()


def test_a_stranger_is_asked_for_a_token_and_a_wrong_one_is_no_use(stranger):
    stranger.goto("/")
    expect(stranger.get_by_role("dialog", name="Sign in")).to_be_visible()
    sign_in(stranger, "not-a-token")
    expect(stranger.get_by_role("dialog", name="Sign in")).to_be_visible()
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
    expect(stranger.get_by_role("dialog", name="Sign in")).to_be_visible()


def test_a_viewer_may_not_steer_the_payload(stranger, guarded, console):
    stranger.goto("/live")
    sign_in(stranger, guarded[1])
    expect(stranger.locator("#state")).to_have_text("connected")
    console.heard.clear()
    expect(stranger.get_by_role("button", name="Pause")).to_be_hidden()
    stranger.locator("#pause").dispatch_event("click")  # a viewer who does not use the page
    expect(stranger.locator("#state")).to_contain_text("operator")
    assert console.heard == []


def test_a_page_that_needs_a_sign_in_opens_after_it(stranger, guarded):
    stranger.goto("/reports/" + "0" * 32)
    expect(stranger.get_by_role("dialog", name="Sign in")).to_be_visible()
    sign_in(stranger, guarded[1])
    stranger.wait_for_url("**/reports/" + "0" * 32)
    expect(stranger.locator("body")).to_contain_text("not found")


@pytest.mark.parametrize("address", ["/reports/{key}#part", "/?next=/reports/{key}%23part"])
def test_the_part_of_a_page_in_the_address_is_kept_over_the_sign_in(stranger, guarded, address):
    stranger.goto(address.format(key="0" * 32))
    expect(stranger.get_by_role("dialog", name="Sign in")).to_be_visible()
    sign_in(stranger, guarded[1])
    expect(stranger).to_have_url(f"{guarded[0]}/reports/{'0' * 32}#part")


@pytest.mark.parametrize("next_page", ["//example.org/", "/%5Cexample.org/", "https://example.org/"])
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
        visited.append(
            stranger.evaluate("document.activeElement.closest('dialog, main, header, footer')?.id")
        )
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
