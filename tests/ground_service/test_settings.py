"""Settings: from the environment, from files, and refused in one line."""

from pytest import fixture, mark, raises

from ground_service.errors import SettingsError
from ground_service.settings import SECRETS, URLS, load_settings, normalised_url
from tests.ground_service.conftest import cells


@fixture(autouse=True)
def bare(monkeypatch, tmp_path):
    for name in ("HOME", "DATABASE_URL", "BROKER_URL", "HOST", "PORT", "DATABASE_URL_FILE", "BROKER_URL_FILE"):
        monkeypatch.delenv(f"LINNA_{name}", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))


def test_nothing_set_means_sqlite_and_jobs_in_process(tmp_path):
    settings = load_settings()
    assert settings.resolved_database_url() == f"sqlite:///{tmp_path / 'linna' / 'linna.db'}"
    assert settings.resolved_broker_url() is None
    assert settings.host == "127.0.0.1"


def test_what_is_given_goes_before_the_environment(monkeypatch):
    monkeypatch.setenv("LINNA_PORT", "9000")
    assert load_settings().port == 9000
    assert load_settings(port=None).port == 9000
    assert load_settings(port=9001).port == 9001


def test_secrets_can_come_from_files_and_are_not_printed(monkeypatch, tmp_path):
    (tmp_path / "url").write_text("postgres://linna:geheim@db/linna\n")
    monkeypatch.setenv("LINNA_DATABASE_URL_FILE", str(tmp_path / "url"))
    settings = load_settings()
    assert settings.resolved_database_url() == "postgresql+psycopg://linna:geheim@db/linna"
    assert "geheim" not in repr(settings)


def test_a_password_can_come_from_a_file_of_its_own(monkeypatch, tmp_path):
    (tmp_path / "password").write_text("a/b@c\n")
    for name in ("DATABASE", "MIGRATION_DATABASE", "BROKER"):
        monkeypatch.setenv(f"LINNA_{name}_PASSWORD_FILE", str(tmp_path / "password"))
    monkeypatch.setenv("LINNA_DATABASE_URL", "postgresql://linna@db/linna")
    monkeypatch.setenv("LINNA_MIGRATION_DATABASE_URL", "postgresql://owner:own@db/linna")
    monkeypatch.setenv("LINNA_BROKER_URL", "redis://linna@broker:6379/0")
    settings = load_settings()
    assert settings.resolved_database_url() == "postgresql+psycopg://linna:a%2Fb%40c@db/linna"
    # One that is there already is kept.
    assert settings.resolved_migration_url() == "postgresql+psycopg://owner:own@db/linna"
    assert settings.resolved_broker_url() == "redis://linna:a%2Fb%40c@broker:6379/0"


WRONG = """
LINNA_PORT | seventy | LINNA_PORT: expected input should be a valid integer
LINNA_PORT | 70000 | LINNA_PORT: expected input should be less than or equal to 65535
LINNA_TRUSTED_PROXIES | proxy | ^LINNA_TRUSTED_PROXIES: expected IP addresses or networks, found 'proxy'$
LINNA_DATABASE_URL_FILE | /does/not/exist | LINNA_DATABASE_URL_FILE: expected a readable file
"""


@mark.parametrize("name, value, message", cells(WRONG))
def test_a_wrong_setting_is_named(monkeypatch, name, value, message):
    monkeypatch.setenv(name, value)
    with raises(SettingsError, match=message):
        load_settings()


@mark.parametrize("name", [*URLS, *SECRETS, "database_password", "broker_password"])
@mark.parametrize(
    "octets, message",
    [
        (b"", "expected a file with a value, found an empty file"),
        (b" \n", "expected a file with a value, found an empty file"),
        (b"\xff\xfe\x00", r"expected a text file \(UTF-8\), found other octets"),
        (b"one\ntwo\n", "expected one line, found control characters or further lines"),
    ],
)
def test_an_unusable_secret_is_refused_in_one_line_and_never_replaced_by_a_default(
    monkeypatch, tmp_path, name, octets, message
):
    (tmp_path / "secret").write_bytes(octets)
    monkeypatch.setenv(f"LINNA_{name.upper()}_FILE", str(tmp_path / "secret"))
    monkeypatch.setenv("LINNA_BROKER_URL", "redis://linna@broker:6379/0")
    if name == "database_password":
        monkeypatch.setenv("LINNA_DATABASE_URL", "postgresql://linna@db/linna")
    with raises(SettingsError, match=f"^LINNA_{name.upper()}_FILE: {message}") as error:
        load_settings()
    assert str(tmp_path / "secret") in str(error.value) and "\n" not in str(error.value)


@mark.parametrize("url", ["nonsense", "amqp://linna:geheim@broker/0", "redis://", "//linna:geheim@broker"])
def test_a_broker_other_than_redis_is_refused_without_showing_its_password(monkeypatch, url):
    monkeypatch.setenv("LINNA_BROKER_URL", url)
    with raises(SettingsError) as error:
        load_settings()
    expected = "LINNA_BROKER_URL: expected a URL such as redis://host:6379/0, found another one"
    assert str(error.value) == expected


def test_a_password_without_a_user_is_refused(monkeypatch, tmp_path):
    (tmp_path / "password").write_text("geheim")
    monkeypatch.setenv("LINNA_BROKER_PASSWORD_FILE", str(tmp_path / "password"))
    monkeypatch.setenv("LINNA_BROKER_URL", "redis://broker:6379/0")
    with raises(SettingsError, match="LINNA_BROKER_URL: expected a URL with a user") as error:
        load_settings()
    assert "geheim" not in str(error.value)
    monkeypatch.setenv("LINNA_BROKER_URL", "redis://:other@broker:6379/0")
    assert load_settings().resolved_broker_url() == "redis://:other@broker:6379/0"


@mark.parametrize("spelling", ["postgres://h/d", "postgresql://h/d", "postgresql+psycopg://h/d"])
def test_the_installed_driver_is_used_whatever_the_spelling(spelling):
    assert normalised_url(spelling) == "postgresql+psycopg://h/d"
