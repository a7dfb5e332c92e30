"""Sign-in with an OpenID provider in the browser. The provider has another host name: it is another site."""

import re

import pytest

from tests.ground_service.access.openid import CLIENT, SECRET, running_provider
from tests.ground_service.web.conftest import patient
from tests.lazy import expect


@pytest.fixture(scope="module")
def provider():
    with running_provider() as running:
        running.claims["roles"] = ["linna-admins"]
        yield running


@pytest.fixture(scope="module")
def signed_in_elsewhere(tmp_path_factory, serve, console, provider):
    """The address of a service whose users sign in with the provider."""
    home = tmp_path_factory.mktemp("openid") / "home"
    home.mkdir()
    (home.parent / "secret").write_text(SECRET)
    settings = {
        "LINNA_OIDC_ISSUER": provider.issuer,
        "LINNA_OIDC_CLIENT_ID": CLIENT,
        "LINNA_OIDC_CLIENT_SECRET_FILE": str(home.parent / "secret"),
        "LINNA_OIDC_ROLES": "admin=linna-admins",
    }
    with serve(home, console.port, settings=settings) as running:
        yield running.url.replace("127.0.0.1", "localhost")


def test_a_user_comes_back_signed_in_to_the_page_and_signs_out_everywhere(
    browser, signed_in_elsewhere, provider
):
    """The session cookie is strict: a redirect from the provider to the page would come without it."""
    url = signed_in_elsewhere
    assert "localhost" in url and "127.0.0.1" in provider.issuer
    context = patient(browser.new_context(base_url=url))
    page = context.new_page()
    page.goto("/users?offset=0#tokens")
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()
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
    expect(page.get_by_role("dialog", name="Sign in")).to_be_visible()
    context.close()
