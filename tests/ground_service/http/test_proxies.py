"""Client address behind a chain of reverse proxies."""

import pytest

from ground_service.errors import SettingsError
from ground_service.http.proxies import TrustedProxies, address_key
from ground_service.settings import load_settings

PROXIES = TrustedProxies(["10.0.0.0/8", "192.0.2.9", "2001:db8::/32"])


@pytest.mark.parametrize(
    ("chain", "client"),
    [
        ("198.51.100.4", "198.51.100.4"),
        ("198.51.100.4, 10.1.1.1", "198.51.100.4"),
        # What the client itself claims stands to the left of its address.
        ("1.1.1.1, 198.51.100.4, 192.0.2.9", "198.51.100.4"),
        ("198.51.100.4:5555", "198.51.100.4"),
        ("[2001:db9::1]:443", "2001:db9::1"),
        ("::ffff:198.51.100.4", "198.51.100.4"),
        ("10.1.1.1, 10.1.1.2", "10.1.1.1"),
        ("198.51.100.4, garbage", "10.0.0.1"),
        ("", "10.0.0.1"),
    ],
)
def test_the_client_is_the_last_address_that_no_trusted_proxy_has(chain: str, client: str) -> None:
    assert PROXIES.client("10.0.0.1", chain) == client


def test_callers_are_told_apart_by_address_and_by_ipv6_network() -> None:
    assert address_key("198.51.100.4") == "198.51.100.4"
    assert address_key("2001:db8:1:2:3::4") == address_key("2001:db8:1:2::") != address_key("2001:db8:1:3::")
    assert address_key("testclient") == "testclient"


def test_a_proxy_that_is_no_address_is_refused_at_the_start(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LINNA_TRUSTED_PROXIES", "10.0.0.1, proxy.example")
    with pytest.raises(SettingsError, match=r"LINNA_TRUSTED_PROXIES: .*found 'proxy\.example'"):
        load_settings()
    monkeypatch.setenv("LINNA_TRUSTED_PROXIES", "10.0.0.1, 10.2.0.0/16,")
    monkeypatch.setenv("LINNA_ALLOWED_HOSTS", "ground.example,other.example")
    settings = load_settings()
    assert settings.trusted_proxies == ("10.0.0.1", "10.2.0.0/16")
    assert settings.allowed_hosts == ("ground.example", "other.example")
