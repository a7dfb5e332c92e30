"""Object store for tests: a local server with the S3 interface, which can be stopped and started with its objects."""

import logging
from contextlib import contextmanager

from pydantic import SecretStr

from ground_service.settings import Settings
from ground_service.store.objects import objects_of


class ObjectServer:
    """Server with one bucket on a private port; its objects are in the memory of this process."""

    def __init__(self, port, bucket):
        self.port, self.bucket = port, bucket
        self._server = None
        self.start()
        self.store()._client().create_bucket(Bucket=bucket)

    def start(self):
        from moto.server import ThreadedMotoServer

        logging.getLogger("werkzeug").setLevel(logging.ERROR)
        self._server = ThreadedMotoServer(ip_address="127.0.0.1", port=self.port)
        self._server.start()
        self.port = self._server.get_host_and_port()[1]

    def stop(self):
        if self._server is not None:
            self._server.stop()
        self._server = None

    def settings(self):
        """Return the settings of a service that uses this store."""
        return {
            "objects": f"s3://{self.bucket}/operations", "objects_endpoint": f"http://127.0.0.1:{self.port}",
            "objects_region": "us-east-1", "objects_access_key": SecretStr("key"),
            "objects_secret_key": SecretStr("secret"),
        }  # fmt: skip

    def environment(self):
        """Return the same as variables of the environment."""
        return {
            f"LINNA_{name.upper()}": value.get_secret_value() if isinstance(value, SecretStr) else value
            for name, value in self.settings().items()
        }

    def store(self):
        """Return the store as a service sees it."""
        return objects_of(Settings(**self.settings()))


@contextmanager
def running_objects(bucket):
    """Yield an object store with an empty bucket."""
    server = ObjectServer(0, bucket)
    try:
        yield server
    finally:
        server.stop()
