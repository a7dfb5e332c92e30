"""Point-in-time recovery with the scripts of the compose file: every table is deleted, then restored to a second."""

import os
import re
import shutil
import subprocess
import tempfile
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

from pytest import fixture, skip
from sqlalchemy import text

from ground_service.access import service as users
from ground_service.ground import open_ground
from ground_service.store import audit
from ground_service.store.database import open_database, prepare_database
from ground_service.store.models import METADATA
from tests.ground_service.conftest import free_port
from tests.serving import ran, wait_for

SYSTEM = "/usr/sbin:/usr/bin:/sbin:/bin"
DEPLOY = Path(__file__).resolve().parents[3] / "deploy"


class Server:
    """A PostgreSQL server with the options of deploy/postgres.sh and the archive of its log in `wal`."""

    def __init__(self, folder):
        self.folder, self.wal, self.data, self.port = folder, folder / "wal", folder / "data", free_port()
        self.bin = sorted(Path("/usr/lib/postgresql").glob("*/bin"))[-1]
        self.user = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        self.url = f"postgresql+psycopg://linna@127.0.0.1:{self.port}/linna"
        self.scripts = folder / "scripts"
        self.second = 0
        shutil.copytree(DEPLOY, self.scripts)
        self.scripts.chmod(0o755)

    def run(self, *words, check=True):
        environment = {"PATH": f"{self.bin}:{SYSTEM}", "LINNA_WAL": str(self.wal)}
        return ran([*self.user, *words], check=check, cwd=self.folder, env=environment)

    def start(self):
        script = (self.scripts / "postgres.sh").read_text()
        options = re.findall(r"-c (\w+)=('[^']*'|\S+)", script)
        named = ["max_connections", "wal_level", "archive_mode", "archive_timeout", "archive_command"]
        assert [name for name, _ in options] == named
        lines = [f"{name} = {value}" for name, value in options]
        own = [f"port = {self.port}", f"unix_socket_directories = '{self.folder}'", "listen_addresses = '127.0.0.1'"]
        settings = "\n".join([*lines, *own]).replace("/linna/", f"{self.scripts}/")
        (self.data / "archive.conf").write_text(settings + "\n")
        with (self.data / "postgresql.conf").open("a") as configuration:
            configuration.write("include_if_exists 'archive.conf'\n")
        log = str(self.folder / "log")
        # Output to the log, so that no pipe stays open.
        words = f"{self.bin / 'pg_ctl'} -D {self.data} -w -t 120 -l {log} start"
        command = [*self.user, *words.split()]
        environment = {"PATH": SYSTEM, "LINNA_WAL": str(self.wal)}
        started = subprocess.run(command, cwd=self.folder, env=environment, stdout=subprocess.DEVNULL, check=False)
        assert started.returncode == 0, Path(log).read_text()

    def stop(self):
        self.run(*f"{self.bin / 'pg_ctl'} -D {self.data} -m immediate -w stop".split(), check=False)

    def script(self, name, *words, check=True):
        return self.run("sh", str(self.scripts / name), *words, check=check)

    def base_backup(self):
        while int(time.time()) == self.second:  # names of backups have seconds
            time.sleep(0.02)
        self.second = int(time.time())
        place = ["--host", "127.0.0.1", "--port", str(self.port), "--username", "linna"]
        return self.script("base-backup.sh", *place).stdout.strip()


@fixture(scope="module")
def server():
    """A server for all tests; the last one destroys and restores its database."""
    if not sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres")):
        skip("PostgreSQL is not installed")
    folder = Path(tempfile.mkdtemp(prefix="linna-recovery-"))
    made = Server(folder)
    if made.user:
        shutil.chown(folder, "postgres", "postgres")
    try:
        made.run("mkdir", str(made.wal))
        made.run(*f"{made.bin / 'initdb'} -D {made.data} -U linna -A trust -E UTF8 --no-sync".split())
        made.start()
        made.run(*f"{made.bin / 'createdb'} -h 127.0.0.1 -p {made.port} -U linna linna".split())
        yield made
    finally:
        made.stop()
        shutil.rmtree(folder, ignore_errors=True)


def scalar(ground, statement):
    """Return the value of a statement in a transaction that only reads, also while the server recovers."""
    with ground.database.snapshot() as connection:
        return connection.execute(text(statement)).scalar()


def server_time(ground):
    return scalar(ground, "SELECT clock_timestamp()").astimezone(UTC)


def next_second(ground):
    """Return the next full second, when it has passed."""
    chosen = server_time(ground).replace(microsecond=0) + timedelta(seconds=1)
    wait_for(lambda: server_time(ground) > chosen, "the next second")
    return chosen


def archive_all(ground):
    """Have the log so far archived, and wait until it is."""
    with ground.database.writing() as connection:
        segment = connection.execute(text("SELECT pg_walfile_name(pg_switch_wal())")).scalar_one()

    def is_archived():
        last = scalar(ground, "SELECT last_archived_wal FROM pg_stat_archiver")
        return last is not None and not last.endswith(".backup") and last >= segment

    wait_for(is_archived, f"{segment} in the archive")


def test_a_recovery_without_its_conditions_is_refused(server):
    server.base_backup()
    before = (datetime.now(UTC) - timedelta(hours=1)).strftime("%Y-%m-%d %H:%M:%S+00")
    refused = server.script("restore-to.sh", str(server.folder / "new"), before, check=False)
    assert refused.returncode == 2 and "expected a base backup before" in refused.stderr
    refused = server.script("restore-to.sh", str(server.data), before, check=False)
    assert refused.returncode == 2 and "expected an empty folder" in refused.stderr


def test_old_base_backups_go_with_the_log_that_only_they_need(server):
    made = [Path(server.base_backup()) for _ in range(3)]
    assert sorted(path.name for path in (server.wal / "base").iterdir()) == [one.name for one in made[1:]]
    (first,) = re.findall(r"\(file (\w+)\)", (made[1] / "backup_label").read_text().splitlines()[0])
    kept = sorted(path.name for path in server.wal.iterdir() if re.fullmatch("[0-9A-F]{24}", path.name))
    assert all(name >= first for name in kept)


def test_the_database_is_restored_to_a_chosen_second(server, tmp_path):
    prepare_database(server.url, upgrade=True).engine.dispose()
    with open_ground(tmp_path / "home", database_url=server.url) as ground:
        users.add_user(ground, "in-the-backup", "viewer")
        base = server.base_backup()
        next_second(ground)
        users.add_user(ground, "before", "viewer")
        chosen = next_second(ground)
        users.add_user(ground, "after", "viewer")
        database = open_database(server.url)
        METADATA.drop_all(database.engine)
        database.engine.dispose()
        archive_all(ground)
    server.stop()
    shutil.rmtree(server.data)  # the disk of the database is lost, the archive is not
    target = chosen.strftime("%Y-%m-%d %H:%M:%S+00")
    assert Path(base).name in server.script("restore-to.sh", str(server.data), target).stdout
    server.start()
    with open_ground(tmp_path / "home", database_url=server.url) as ground:
        wait_for(lambda: not scalar(ground, "SELECT pg_is_in_recovery()"), "the end of the recovery")
        assert [one.name for one in users.list_users(ground)] == ["before", "in-the-backup"]
        with ground.database.snapshot() as connection:
            assert list(audit.broken_entries(connection)) == []
        users.add_user(ground, "afterwards", "viewer")  # the service continues, on a new timeline
