"""Pages of administrators: users with their tokens, and the status of the service."""

import pytest

from ground_service.access.service import add_user, list_tokens, list_users
from ground_service.ground import open_ground
from tests.ground_service.web.conftest import patient
from tests.lazy import expect
from tests.serving import token_valid


@pytest.fixture(scope="module")
def managed(tmp_path_factory, serve, console):
    """A service with an administrator and a viewer: address, home folder, token of the administrator."""
    home = tmp_path_factory.mktemp("managed") / "home"
    with open_ground(home) as ground:
        token = add_user(ground, "ann", "admin")
        add_user(ground, "vic", "viewer")
    with serve(home, console.port) as running:
        yield running.url, home, token


@pytest.fixture
def admin(browser, managed):
    """The page of users, of an administrator who has signed in."""
    context = patient(browser.new_context(base_url=managed[0]))
    page = context.new_page()
    page.goto("/users")
    page.get_by_label("Token", exact=True).fill(managed[2])
    page.locator("dialog").get_by_role("button", name="Sign in").click()
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
        assert (
            found.expires is not None and 6.9 < (found.expires.utc_ns - found.created.utc_ns) / 86_400e9 < 7.1
        )
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
        assert {one.name: (one.role, one.state) for one in list_users(ground)}["vic"] == (
            "operator",
            "active",
        )


def test_a_token_is_revoked(admin, managed):
    admin.get_by_role("button", name="New token for vic").click()
    expect(admin.locator("#given code")).to_be_visible()
    token = admin.locator("#given code").inner_text()
    row = admin.get_by_role("row").filter(has_text=token[:12])
    row.get_by_role("button", name="Revoke").click()
    expect(row).to_contain_text("revoked")
    with open_ground(managed[1]) as ground:
        assert not token_valid(ground, token)


def test_the_last_administrator_stays(admin, managed):
    admin.get_by_role("button", name="Disable ann").click()
    expect(admin.locator("#notices")).to_contain_text("expected another active administrator")
    with open_ground(managed[1]) as ground:
        assert {one.name: one.state for one in list_users(ground)}["ann"] == "active"


def test_the_status_states_what_is_known_and_what_is_not(admin):
    admin.goto("/status")
    row = admin.get_by_role("row").filter(has_text="Newest backup")
    expect(row).to_contain_text("unknown")
    expect(admin.locator("#correlations")).to_contain_text("No time correlation.")
    expect(admin.get_by_role("row").filter(has_text="Free disk space")).to_contain_text("GiB")
    # The server gets the lease of the recurring work some seconds after its start; the page asks again.
    expect(admin.get_by_role("row").filter(has_text="Recurring work is done by")).not_to_contain_text(
        "no process"
    )
    expect(admin.locator("#complaints")).to_contain_text("No backup is known.")
    for text in ("No process does the recurring work.", "The newest backup is"):
        expect(admin.locator("#complaints")).not_to_contain_text(text)
