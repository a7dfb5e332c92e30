"""Sign-in with an OpenID provider: a real provider on a private port, and every way in which an answer can be wrong."""

import base64
import hmac
import json
import re
import time
from datetime import UTC, datetime
from urllib.parse import parse_qs, urlsplit

from joserfc import jwk
from pytest import fixture, mark, raises

from ground_service.access import provider as oidc
from ground_service.access import service as users
from ground_service.access.model import AuditFilter
from ground_service.access.security import SESSION_COOKIE
from ground_service.access.store import end_provider_sessions, list_audit
from ground_service.app import create_app
from ground_service.errors import Conflict, SettingsError
from ground_service.settings import Settings, load_settings
from ground_service.worker.upkeep import tidy
from tests.ground_service.access.openid import CLIENT, SECRET, running_provider
from tests.ground_service.conftest import cells
from tests.serving import TestClient, token_valid

OWN = {"Origin": "http://testserver"}
ROLES = ("admin=linna-admins", "operator=linna-operators", "viewer=linna-viewers")


@fixture
def provider():
    with running_provider() as running:
        yield running


def settings(home, provider, **given):
    return Settings(
        home=home, oidc_issuer=provider.issuer, oidc_client_id=CLIENT, oidc_client_secret=SECRET, oidc_roles=ROLES,
        **given,
    )  # fmt: skip


@fixture
def client(tmp_path, provider):
    app = create_app(settings(tmp_path, provider), inline_jobs=True)
    with TestClient(app, follow_redirects=False) as opened:
        yield opened


@fixture
def ground(client):
    return client.app.state.ground


def begun(client, page="/"):
    answer = client.get("/sign-in/provider", params={"next": page})
    assert answer.status_code == 303, answer.text
    return str(answer.headers["location"])


def answered(client, provider, page="/"):
    """The page of this service after a sign-in at the provider."""
    return client.get(provider.authorise(begun(client, page)))


def refused(answer, *words, status=401):
    assert answer.status_code == status, answer.text
    assert "linna_session=" not in answer.headers.get("set-cookie", "")
    for word in words:
        assert word in answer.text


def session_of(client):
    answer = client.get("/api/v1/session")
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_a_user_of_the_provider_is_added_with_the_role_and_gets_a_session(client, ground, provider):
    answer = answered(client, provider, "/passes?x=1#part")
    assert answer.status_code == 200 and answer.headers["cache-control"] == "no-store"
    assert '<meta http-equiv="refresh" content="0;url=/passes?x=1#part">' in answer.text
    cookies = {line.partition("=")[0]: line.lower() for line in answer.headers.get_list("set-cookie")}
    assert "httponly" in cookies[SESSION_COOKIE] and "samesite=strict" in cookies[SESSION_COOKIE]
    assert "max-age=0" in cookies["linna_sign_in"]
    found = session_of(client)
    assert (found["name"], found["role"], found["browser"], found["provider"]) == (
        "ann", "operator", True, True,
    )  # fmt: skip
    left_s = (datetime.fromisoformat(found["expires"]) - datetime.now(UTC)).total_seconds()
    assert 0 < left_s <= 3600.0  # then the provider states the role again
    assert "max-age=3600" in cookies[SESSION_COOKIE]
    (user,), (token,) = users.list_users(ground), users.list_tokens(ground)
    assert user.provider == provider.issuer and token.kind == "provider session"
    assert [one.action for one in ground.read(list_audit, AuditFilter()).items] == ["start session", "add user"]


def test_the_request_to_the_provider_has_fresh_secrets(client, provider):
    queries = [parse_qs(urlsplit(begun(client)).query) for _ in range(2)]
    for name in "state", "nonce", "code_challenge":
        assert len({query[name][0] for query in queries}) == 2 and len(queries[0][name][0]) >= 43
    assert queries[0]["redirect_uri"] == ["http://testserver/sign-in/callback"]
    assert queries[0]["scope"] == ["openid profile"]


def test_a_service_with_a_provider_and_without_users_is_closed(client):
    assert client.get("/api/v1/passes").status_code == 401


def test_bearer_tokens_remain_valid(client, ground, provider):
    token = users.add_user(ground, "bob", "viewer")
    answered(client, provider)
    found = client.get("/api/v1/session", headers={"Authorization": f"Bearer {token}"}).json()
    assert (found["name"], found["provider"]) == ("bob", False)


def without_none(claims):
    return {name: value for name, value in claims.items() if value is not None}


def test_a_token_that_was_not_made_for_this_sign_in_is_refused(client, ground, provider, subtests):
    wrong = """
        nonce | "another" | nonce
        nonce | null | nonce
        iss | "https://evil.example" | iss
        aud | "another" | aud
        aud | ["linna", "another"] | azp
        azp | "another" | azp
        exp | null | exp
        iat | null | iat
        at_hash | "another" | at_hash
    """
    for claim, value, word in cells(wrong):
        change = {claim: json.loads(value)}
        provider.change = lambda claims, change=change: without_none(claims | change)
        with subtests.test(change=change):
            refused(answered(client, provider), "ID token", word)
            assert users.list_users(ground) == []


def test_clocks_may_differ_by_a_minute(client, provider, subtests):
    """The token is valid for 300 s from the time of the provider's clock."""
    for shift_s, word in (-330, None), (-400, "expired"), (40, None), (100, "iat"):
        provider.change = lambda claims, shift_s=shift_s: (
            claims | {one: claims[one] + shift_s for one in ("iat", "exp")}
        )
        with subtests.test(shift_s=shift_s):
            answer = answered(client, provider)
            if word is None:
                assert answer.status_code == 200
            else:
                refused(answer, "ID token", word)


def test_a_token_of_another_key_is_refused(client, provider):
    provider.key = jwk.RSAKey.generate_key(2048, {"kid": "1"}, private=True)
    refused(answered(client, provider), "a signature of a key of the provider")


@mark.parametrize("algorithm", ["none", "HS256"])
def test_a_token_without_an_asymmetric_signature_is_refused(client, provider, algorithm, monkeypatch):
    """With HS256, the public key of the provider could be used as the secret."""

    def part(octets):
        return base64.urlsafe_b64encode(octets).rstrip(b"=").decode()

    def signed(claims, key=None):
        header = {"alg": algorithm, "kid": "1"}
        text = ".".join(part(json.dumps(one).encode()) for one in (header, claims))
        mac = hmac.digest(provider.key.as_pem(private=False), text.encode(), "sha256")
        return f"{text}.{part(mac) if algorithm == 'HS256' else ''}"

    monkeypatch.setattr(provider, "signed", signed)
    refused(answered(client, provider), "a signature of a key of the provider")


def test_new_keys_of_the_provider_are_read_once(client, provider, monkeypatch):
    answered(client, provider)
    provider.key = jwk.RSAKey.generate_key(2048, {"kid": "2"}, private=True)
    provider.published = [provider.key]
    refused(answered(client, provider), "a signature of a key of the provider")  # too soon after the last
    monkeypatch.setattr(oidc, "KEYS_AGAIN_S", 0.0)
    assert answered(client, provider).status_code == 200
    before = provider.requests.count("/realms/ops/keys")
    assert answered(client, provider).status_code == 200
    assert provider.requests.count("/realms/ops/keys") == before


def test_elliptic_keys_are_accepted(client, provider):
    provider.key = jwk.ECKey.generate_key("P-256", {"kid": "e"}, private=True)
    provider.algorithm, provider.published = "ES256", [provider.key]
    assert answered(client, provider).status_code == 200


def test_a_user_without_a_role_is_refused(client, ground, provider, subtests):
    for roles in [], ["visitors"], None, "", 7:
        provider.claims["roles"] = roles
        with subtests.test(roles=roles):
            expected = ("role", "claim roles", "linna-admins, linna-operators, linna-viewers")
            refused(answered(client, provider), *expected)
            assert users.list_users(ground) == []


def test_the_highest_role_counts_and_each_sign_in_brings_the_present_one(client, ground, provider):
    provider.claims["roles"] = ["linna-viewers", "linna-admins", "others"]
    answered(client, provider)
    assert session_of(client)["role"] == "admin"
    provider.claims["roles"] = "linna-viewers"
    answered(client, provider)
    assert session_of(client)["role"] == "viewer"
    assert ground.read(list_audit, AuditFilter(action="change role")).total == 1


def test_a_user_who_lost_the_role_loses_the_sessions_and_tokens(client, ground, provider):
    answered(client, provider)
    token = users.add_token(ground, "ann")
    provider.claims["roles"] = []
    refused(answered(client, provider), "role")
    assert client.get("/api/v1/session").status_code == 401
    assert not token_valid(ground, token)
    assert ground.read(list_audit, AuditFilter(action="refuse sign-in")).total == 1


def test_roles_inside_an_object_are_found(tmp_path, provider):
    provider.claims["realm_access"] = {"roles": ["linna-admins"]}
    app = create_app(settings(tmp_path, provider, oidc_role_claim="realm_access.roles"), inline_jobs=True)
    with TestClient(app, follow_redirects=False) as client:
        answered(client, provider)
        assert session_of(client)["role"] == "admin"


def test_a_name_of_the_provider_does_not_take_over_a_user_of_this_service(client, ground, provider):
    users.add_user(ground, "ann", "admin")
    refused(answered(client, provider), "user ann")
    assert [one.provider for one in users.list_users(ground)] == [None]


def test_another_subject_with_the_same_name_is_refused(client, provider):
    answered(client, provider)
    provider.claims["sub"] = "u-2"
    refused(answered(client, provider), "user ann")


def test_a_user_is_known_by_the_subject_whatever_the_name(client, provider):
    answered(client, provider)
    provider.claims["preferred_username"] = "anna"
    answered(client, provider)
    assert session_of(client)["name"] == "ann"


def test_a_name_that_users_cannot_have_is_refused(client, provider, subtests):
    for name in "service", "a b", "", None:
        provider.claims["preferred_username"] = name
        with subtests.test(name=name):
            refused(answered(client, provider), "name")


def test_a_disabled_user_is_refused(client, ground, provider):
    answered(client, provider)
    users.change_user(ground, "ann", state="disabled")
    assert client.get("/api/v1/session").status_code == 401
    refused(answered(client, provider), "state active", "disabled")


def test_a_state_is_used_once(client, provider):
    """Also at a provider that accepts a code again."""
    provider.codes_once = False
    address = provider.authorise(begun(client))
    cookie = client.cookies["linna_sign_in"]
    assert client.get(address).status_code == 200
    client.cookies.clear()
    refused(client.get(address), "this browser began")
    client.cookies.set("linna_sign_in", cookie)
    refused(client.get(address), "state: expected one that was not used before")


def test_a_code_is_used_once(client, provider):
    address = provider.authorise(begun(client))
    cookie = client.cookies["linna_sign_in"]
    client.get(address)
    client.cookies.set("linna_sign_in", cookie)
    refused(client.get(address), "code", "invalid_grant")


def test_the_answer_to_a_sign_in_of_another_browser_is_refused(client, provider):
    """Somebody could otherwise sign in a victim under an account of the attacker."""
    stolen = provider.authorise(begun(client))
    client.cookies.clear()
    refused(client.get(stolen), "state", "this browser began")
    begun(client)
    refused(client.get(stolen), "state", "another")


def test_a_code_is_no_use_without_its_verifier(client, provider):
    address = provider.authorise(begun(client))
    state, nonce, _, page = client.cookies["linna_sign_in"].split(".", 3)
    client.cookies.clear()
    client.cookies.set("linna_sign_in", f"{state}.{nonce}.{'v' * 43}.{page}")
    refused(client.get(address), "invalid_grant")


def test_the_answer_of_another_provider_is_refused(client, provider, subtests):
    for issuer in "&iss=https://evil.example", "":
        address = provider.authorise(begun(client))
        with subtests.test(issuer=issuer):
            refused(client.get(re.sub(r"&iss=[^&]*", issuer, address)), "iss of the answer")


def test_a_refusal_of_the_provider_is_stated(client, provider):
    state = parse_qs(urlsplit(begun(client)).query)["state"][0]
    answer = client.get("/sign-in/callback", params={"state": state, "error": "<b>access_denied"})
    refused(answer, "access_denied")
    assert "<b>" not in answer.text


def test_no_other_address_is_opened_after_a_sign_in(client, provider, subtests):
    pages = r"https://evil.example/ //evil.example/ /\evil.example/ \\evil.example javascript:alert(1) passes /ü"
    for page in *pages.split(), "", "/" + "a" * 2000:
        with subtests.test(page=page):
            assert 'content="0;url=/"' in answered(client, provider, page).text


def test_control_characters_and_spaces_are_no_part_of_a_page():
    assert [oidc.own_page(text) for text in ("/\t/evil.example", "/ /a", "/\n", "/a?b#c")] == ["/", "/", "/", "/a?b#c"]


def test_the_page_in_the_cookie_is_checked_as_well(client, provider):
    address = provider.authorise(begun(client))
    parts = client.cookies["linna_sign_in"].split(".", 3)
    client.cookies.clear()
    client.cookies.set("linna_sign_in", ".".join([*parts[:3], "https%3A%2F%2Fevil.example"]))
    assert 'content="0;url=/"' in client.get(address).text


def test_a_provider_that_is_down_is_no_traceback_and_tokens_still_work(tmp_path):
    with running_provider() as provider:
        pass
    with TestClient(create_app(settings(tmp_path, provider), inline_jobs=True), follow_redirects=False) as client:
        refused(client.get("/sign-in/provider"), "Bearer tokens still work", status=503)
        token = users.add_user(client.app.state.ground, "bob", "viewer")
        assert client.get("/api/v1/session", headers={"Authorization": f"Bearer {token}"}).status_code == 200
        # the page after a sign-out is then one of this service
        assert client.get("/sign-in/ended", params={"next": "//evil.example"}).headers["location"] == "/"


@mark.parametrize(
    "metadata", [{"issuer": "https://evil.example"}, {"token_endpoint": None}, {"jwks_uri": "http://127.0.0.1:1/keys"}]
)
def test_a_provider_whose_configuration_is_wrong_cannot_be_used(client, provider, metadata):
    provider.metadata = metadata
    refused(client.get("/sign-in/provider"), status=503)
    provider.metadata = {}
    assert client.get("/sign-in/provider").status_code == 303  # as soon as it is right


def test_sign_out_ends_the_session_here_and_leads_to_the_provider(client, ground, provider):
    answered(client, provider)
    secret = client.cookies[SESSION_COOKIE]
    assert client.delete("/api/v1/session", headers=OWN).status_code == 204
    assert not token_valid(ground, secret)
    place = client.get("/sign-in/ended").headers["location"]
    assert place.startswith(f"{provider.issuer}/end?client_id=linna&")


def logout_token(provider, **change):
    claims = {
        **provider.common(), "jti": "j-1", "sub": "u-1", "sid": "s-1", "events": {oidc.LOGOUT_EVENT: {}}, **change,
    }  # fmt: skip
    return provider.signed(without_none(claims))


def sign_out(client, token):
    kept = dict(client.cookies)
    client.cookies.clear()  # it comes from a program of the provider
    status = client.post("/sign-in/provider-sign-out", data={"logout_token": token}).status_code
    client.cookies.update(kept)
    return status


@mark.parametrize("change", [{}, {"sub": None}, {"sid": None}])
def test_the_provider_ends_the_session(client, ground, provider, change):
    answered(client, provider)
    secret = client.cookies[SESSION_COOKIE]
    bearer = users.add_token(ground, "ann")
    client.cookies.clear()
    assert sign_out(client, logout_token(provider, **change)) == 200
    assert not token_valid(ground, secret)
    assert token_valid(ground, bearer)  # made by an administrator, not by a sign-in
    assert ground.read(list_audit, AuditFilter(action="end sessions by provider")).total == 1


def test_a_wrong_logout_token_ends_nothing(client, provider, subtests):
    answered(client, provider)
    wrong = """
        {"aud": "another"}
        {"iss": "https://evil.example"}
        {"exp": 1}
        {"events": {}}
        {"events": null}
        {"nonce": "n"}
        {"jti": null}
        {"sub": null, "sid": null}
    """
    for change in map(json.loads, wrong.strip().splitlines()):
        with subtests.test(change=change):
            assert sign_out(client, logout_token(provider, **change)) == 400
            assert client.get("/api/v1/session").status_code == 200


def test_a_logout_token_is_used_once_and_ends_its_session_only(client, ground, provider):
    answered(client, provider)
    assert ground.write(end_provider_sessions, "https://other.example", "u-1", "s-1", time.time_ns()) == {}
    assert sign_out(client, logout_token(provider, sid="s-9")) == 200
    assert client.get("/api/v1/session").status_code == 200
    token = logout_token(provider, jti="j-2")
    client.cookies.clear()
    assert (sign_out(client, token), sign_out(client, token)) == (200, 400)


def test_ended_sessions_of_the_provider_are_removed(client, ground, provider, monkeypatch):
    answered(client, provider)
    users.add_token(ground, "ann", days_valid=0.1)
    later = time.time_ns() + users.SESSION_NS + 1
    monkeypatch.setattr("ground_service.worker.upkeep.utc_now_ns", lambda: later)
    tidy(ground, 90)
    assert [(one.kind, one.state) for one in users.list_tokens(ground)] == [("token", "active")]
    assert len(users.list_users(ground)) == 1


def test_the_page_offers_the_provider_only_where_there_is_one(client, tmp_path):
    assert 'href="/sign-in/provider"' in client.get("/").text
    with TestClient(create_app(Settings(home=tmp_path / "other"), inline_jobs=True)) as plain:
        assert 'href="/sign-in/provider"' not in plain.get("/").text
        assert plain.get("/sign-in/provider").status_code == 404


INCOMPLETE = """
{"oidc_client_id": null} | LINNA_OIDC_CLIENT_ID: expected the name
{"oidc_roles": []} | LINNA_OIDC_ROLES: expected entries
{"oidc_roles": ["admin=a", "viewer=a"]} | LINNA_OIDC_ROLES: expected one role
"""


@mark.parametrize("given, word", cells(INCOMPLETE))
def test_incomplete_settings_are_refused_at_the_start(tmp_path, provider, given, word):
    with raises(SettingsError, match=word):
        create_app(settings(tmp_path, provider).model_copy(update=json.loads(given)))


WRONG = """
OIDC_ISSUER | http://login.example.org | expected an https address
OIDC_ISSUER | login | expected the address
OIDC_ROLES | root=x | expected viewer=, operator= or admin=
OBJECTS | /var/lib/linna | LINNA_OBJECTS
OBJECTS | s3:// | LINNA_OBJECTS
OBJECTS_ENDPOINT | 127.0.0.1:9000 | LINNA_OBJECTS_ENDPOINT
"""


@mark.parametrize("name, value, word", cells(WRONG))
def test_wrong_settings_are_one_line(monkeypatch, name, value, word):
    monkeypatch.setenv(f"LINNA_{name}", value)
    with raises(SettingsError, match=word):
        load_settings()


def test_the_secret_may_be_a_file(monkeypatch, tmp_path):
    (tmp_path / "secret").write_text(f"{SECRET}\n")
    monkeypatch.setenv("LINNA_OIDC_CLIENT_SECRET_FILE", str(tmp_path / "secret"))
    found = load_settings().oidc_client_secret
    assert found is not None and found.get_secret_value() == SECRET


def test_the_role_of_a_user_of_the_provider_is_not_changed_here(client, ground, provider):
    answered(client, provider)
    with raises(Conflict, match="states the role"):
        users.change_user(ground, "ann", role="admin")
