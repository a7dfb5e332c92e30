"""Files in an object store (S3) instead of a folder that all hosts share.

An object has the SHA-256 of its content in its name and is written once. The server verifies this hash before it
accepts an object, and the reader verifies it again.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, BinaryIO
from urllib.parse import urlsplit

from ground_service.errors import NotFound, ObjectsUnavailable, SettingsError

if TYPE_CHECKING:
    from ground_service.settings import Settings

BLOCK_OCTETS = 1 << 20
CONNECT_S, READ_S, ATTEMPTS = 5.0, 30.0, 3

PART_OCTETS = 64 << 20
SINGLE_OCTETS = 1 << 32
"""Largest object that is sent in one request; S3 permits 5 GiB."""

_MISSING = ("404", "NoSuchKey", "NotFound")


@dataclass(frozen=True, slots=True)
class ObjectStore:
    """Objects of a bucket whose names begin with `prefix`. A process makes its own connections."""

    bucket: str
    prefix: str
    endpoint: str | None
    region: str | None
    access_key: str | None = field(repr=False)
    secret_key: str | None = field(repr=False)
    cache_octets: int = 20 << 30
    _clients: dict[int, Any] = field(default_factory=dict, repr=False, compare=False)

    def under(self, folder: str) -> ObjectStore:
        return replace(self, prefix=f"{self.prefix}{folder}/")

    def key(self, sha256: str) -> str:
        """Return the name of the object with this content."""
        return f"{self.prefix}{sha256[:2]}/{sha256}"

    def octets(self, sha256: str) -> int | None:
        """Return the size of an object; None if there is none."""
        with self._errors():
            try:
                found = self._client().head_object(Bucket=self.bucket, Key=self.key(sha256))
            except self._refusal() as error:
                if _code(error) in _MISSING:
                    return None
                raise
        return int(found["ContentLength"])

    def put(self, sha256: str, stream: BinaryIO, octets: int) -> None:
        """Store an object durably; storing it again changes nothing."""
        if self.octets(sha256) == octets:
            return
        place = {"Bucket": self.bucket, "Key": self.key(sha256)}
        digest = base64.b64encode(bytes.fromhex(sha256)).decode()
        with self._errors():
            if octets <= SINGLE_OCTETS:
                self._client().put_object(**place, Body=stream, ContentLength=octets, ChecksumSHA256=digest)
                return
            from boto3.s3.transfer import TransferConfig

            parts = TransferConfig(multipart_threshold=PART_OCTETS, multipart_chunksize=PART_OCTETS)
            extra = {"ChecksumAlgorithm": "SHA256"}
            self._client().upload_fileobj(stream, *place.values(), ExtraArgs=extra, Config=parts)

    def read(self, sha256: str) -> Iterator[bytes]:
        """Yield the octets of an object, block by block."""
        with self._errors():
            try:
                found = self._client().get_object(Bucket=self.bucket, Key=self.key(sha256))
            except self._refusal() as error:
                if _code(error) in _MISSING:
                    raise NotFound("object", sha256) from None
                raise
            yield from found["Body"].iter_chunks(BLOCK_OCTETS)

    def remove(self, sha256: str) -> None:
        """Remove an object, if there is one."""
        with self._errors():
            self._client().delete_object(Bucket=self.bucket, Key=self.key(sha256))

    def names(self) -> Iterator[str]:
        """Yield the names of all objects, without the prefix."""
        with self._errors():
            pages = self._client().get_paginator("list_objects_v2")
            for page in pages.paginate(Bucket=self.bucket, Prefix=self.prefix):
                for one in page.get("Contents", ()):
                    yield str(one["Key"]).removeprefix(self.prefix)

    def require_reachable(self) -> None:
        """Check that the bucket can be used.

        Raises
        ------
        ObjectsUnavailable
            If it cannot.
        """
        with self._errors():
            self._client().head_bucket(Bucket=self.bucket)

    def _client(self) -> Any:
        process = os.getpid()  # connections of a parent process cannot be shared
        client = self._clients.get(process)
        if client is None:
            import boto3
            from botocore.config import Config

            client = boto3.session.Session().client(
                "s3",
                endpoint_url=self.endpoint,
                region_name=self.region,
                aws_access_key_id=self.access_key,
                aws_secret_access_key=self.secret_key,
                config=Config(
                    connect_timeout=CONNECT_S,
                    read_timeout=READ_S,
                    retries={"mode": "standard", "total_max_attempts": ATTEMPTS},
                    s3={"addressing_style": "auto" if self.endpoint is None else "path"},
                ),
            )
            self._clients[process] = client
        return client

    @staticmethod
    def _refusal() -> type[Exception]:
        from botocore.exceptions import ClientError

        found: type[Exception] = ClientError
        return found

    @contextmanager
    def _errors(self) -> Iterator[None]:
        """Translate the errors of the library."""
        from boto3.exceptions import Boto3Error
        from botocore.exceptions import BotoCoreError, ClientError, HTTPClientError

        try:
            yield
        except ClientError as error:
            raise ObjectsUnavailable(self.bucket, _code(error)) from None
        except (BotoCoreError, HTTPClientError, Boto3Error, OSError) as error:
            raise ObjectsUnavailable(self.bucket, f"{type(error).__name__}: {error}") from None


def objects_of(settings: Settings) -> ObjectStore | None:
    """Return the object store of the settings; None without one.

    Raises
    ------
    SettingsError
        If a setting of it is missing or the extra `objects` is not installed.
    """
    if settings.objects is None:
        return None
    try:
        import boto3  # noqa: F401  fail at the start, not at the first file
    except ImportError as error:
        raise SettingsError("LINNA_OBJECTS", "the extra 'objects' to be installed", str(error)) from None
    access, secret = settings.objects_access_key, settings.objects_secret_key
    if (access is None) != (secret is None):
        raise SettingsError("LINNA_OBJECTS_ACCESS_KEY", "an access key and a secret key, or neither", "one")
    parts = urlsplit(settings.objects)
    path = parts.path.strip("/")
    return ObjectStore(
        bucket=parts.netloc,
        prefix=f"{path}/" if path else "",
        endpoint=settings.objects_endpoint,
        region=settings.objects_region,
        access_key=None if access is None else access.get_secret_value(),
        secret_key=None if secret is None else secret.get_secret_value(),
        cache_octets=int(settings.objects_cache_gib * (1 << 30)),
    )


def _code(error: Exception) -> str:
    answer = getattr(error, "response", {})
    return str(answer.get("Error", {}).get("Code", "") or type(error).__name__)
