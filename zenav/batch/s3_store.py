# SPDX-License-Identifier: Apache-2.0
"""Uploads to S3 and stores with its interface: in parts, each verified, visible when all are there.

Each part is sent with its SHA-256, which the store checks. Its answer is checked too: the ETag is the MD5 of what it
has, or with other encryptions it repeats the checksum. Where it says neither, the object is read back. The object's
metadata has the SHA-256 of the whole. Amazon S3 API: CreateMultipartUpload, UploadPart, CompleteMultipartUpload.
"""

import base64
import errno
import hashlib
import re
import socket
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from zenav.batch.storage import Folder, errors_of
from zenav.batch.upload_files import FileState, UploadProgress
from zenav.batch.upload_stores import CHUNK, DamagedError, Pace, Report

MAX_PARTS = 9000  # of an upload; S3 allows 10,000, each of 5 MiB at least
CONNECT_S, READ_S = 10, 60  # without an answer
MD5 = re.compile(r"[0-9a-f]{32}")
SO_MAX_PACING_RATE = 47  # <asm-generic/socket.h>: bytes/s that the kernel sends at most


class S3Store:
    """A folder of a bucket. Credentials and endpoint come from the environment."""

    def __init__(self, url: str, pace: Pace) -> None:
        config: dict[str, Any] = {"connect_timeout": CONNECT_S, "read_timeout": READ_S, "retries": {"max_attempts": 1}}
        if pace.rate:
            config["connector_args"] = {"socket_factory": _PacedSockets(min(int(pace.rate), 2**31 - 1))}
        self.folder, self._pace = Folder(url, config_kwargs=config), pace
        self.folder.system.retries = 1  # the caller waits between tries

    def sha256_of(self, name: str) -> str:
        bucket, key = self._address(name)
        try:
            known = self._call("head_object", Bucket=bucket, Key=key).get("Metadata", {}).get("sha256", "")
            return str(known) or self._sha256_of_content(name)
        except FileNotFoundError:
            return ""

    def put(self, path: Path, content: FileState, name: str, replaces: bool, report: Report) -> None:
        bucket, key = self._address(name)
        progress = UploadProgress.of(path, content, f"s3://{bucket}/{key}") or self._begun(path, content, bucket, key)
        try:
            progress = self._put_parts(path, progress, report)
            if not content.is_of(path):
                raise OSError(f"{path} changed while it was uploaded")
            self._complete(bucket, key, progress, replaces)
        except OSError as error:
            is_useless = isinstance(error, FileNotFoundError | FileExistsError) or error.errno == errno.EINVAL
            if is_useless or (error.errno == errno.EREMOTEIO and not self._knows(progress)):
                self._drop(path, progress)  # the store has lost it, or does not want it
            raise
        self._check(path, content, name, progress)
        UploadProgress.remove(path)

    def confirm(self, path: Path, content: FileState, name: str) -> None:
        """The metadata says what was sent, not what is there."""
        bucket, key = self._address(name)
        if (progress := UploadProgress.of(path, content, f"s3://{bucket}/{key}")) is not None:
            self._check(path, content, name, progress)
        self.abandon(path)

    def abandon(self, path: Path) -> None:
        if (progress := UploadProgress.left(path)) is not None:
            self._drop(path, progress)

    def _begun(self, path: Path, content: FileState, bucket: str, key: str) -> UploadProgress:
        if (before := UploadProgress.left(path)) is not None:
            self._drop(path, before)
        reply = self._call(
            "create_multipart_upload",
            Bucket=bucket,
            Key=key,
            Metadata={"sha256": content.sha256},
            ChecksumAlgorithm="SHA256",
        )
        progress = UploadProgress(
            size=content.size,
            changed=content.changed,
            sha256=content.sha256,
            url=f"s3://{bucket}/{key}",
            upload_id=reply["UploadId"],
            part_size=max(CHUNK, -(-content.size // MAX_PARTS)),
        )
        progress.write(path)
        return progress

    def _put_parts(self, path: Path, progress: UploadProgress, report: Report) -> UploadProgress:
        bucket, _, key = progress.url.removeprefix("s3://").partition("/")
        with path.open("rb") as file:
            file.seek(len(progress.parts) * progress.part_size)
            while data := file.read(progress.part_size):
                checksum = base64.b64encode(hashlib.sha256(data).digest()).decode()
                reply = self._call(
                    "upload_part",
                    Bucket=bucket,
                    Key=key,
                    UploadId=progress.upload_id,
                    PartNumber=len(progress.parts) + 1,
                    Body=data,
                    ChecksumSHA256=checksum,
                )
                is_verified = part_is_verified(reply, data, checksum)
                progress = replace(
                    progress,
                    parts=(*progress.parts, (reply["ETag"], checksum)),
                    is_verified=progress.is_verified and is_verified,
                )
                progress.write(path)
                self._pace.sent(len(data))
                report(min(len(progress.parts) * progress.part_size, progress.size))
        return progress

    def _complete(self, bucket: str, key: str, progress: UploadProgress, replaces: bool) -> None:
        parts = [
            {"PartNumber": number, "ETag": etag, "ChecksumSHA256": checksum}
            for number, (etag, checksum) in enumerate(progress.parts, 1)
        ]
        self._call(
            "complete_multipart_upload",
            Bucket=bucket,
            Key=key,
            UploadId=progress.upload_id,
            MultipartUpload={"Parts": parts},
            **({} if replaces else {"IfNoneMatch": "*"}),
        )

    def _check(self, path: Path, content: FileState, name: str, progress: UploadProgress) -> None:
        """Raises DamagedError where the finished object has other bytes; it is removed then."""
        bucket, key = self._address(name)
        size = self._call("head_object", Bucket=bucket, Key=key)["ContentLength"]
        is_same = size == content.size and (progress.is_verified or self._sha256_of_content(name) == content.sha256)
        if not is_same:
            self._call("delete_object", Bucket=bucket, Key=key)
            UploadProgress.remove(path)
            raise DamagedError(f"{progress.url} had other bytes than were sent; it is uploaded again")

    def _sha256_of_content(self, name: str) -> str:
        place, digest = f"{self.folder.path}/{name}", hashlib.sha256()
        options = {"block_size": CHUNK, "cache_type": "none"}
        with errors_of(f"{self.folder.url}/{name}"), self.folder.system.open(place, "rb", **options) as file:
            while data := file.read(CHUNK):
                digest.update(data)
        return digest.hexdigest()

    def _knows(self, progress: UploadProgress) -> bool:
        """Whether the store has this upload; some that have lost it answer a part with an internal error."""
        bucket, _, key = progress.url.removeprefix("s3://").partition("/")
        try:
            self._call("list_parts", Bucket=bucket, Key=key, UploadId=progress.upload_id, MaxParts=1)
        except FileNotFoundError:
            return False
        except OSError:
            return True
        return True

    def _drop(self, path: Path, progress: UploadProgress) -> None:
        bucket, _, key = progress.url.removeprefix("s3://").partition("/")
        with suppress(OSError):
            self._call("abort_multipart_upload", Bucket=bucket, Key=key, UploadId=progress.upload_id)
        UploadProgress.remove(path)

    def _address(self, name: str) -> tuple[str, str]:
        bucket, key, _ = self.folder.system.split_path(f"{self.folder.path}/{name}")
        return bucket, key

    def _call(self, method: str, **arguments: Any) -> dict[str, Any]:
        try:
            reply: dict[str, Any] = self.folder.system.call_s3(method, **arguments)
        except OSError:
            raise
        except Exception as error:  # of botocore, aiohttp: no credentials, no connection, no answer
            raise OSError(str(error) or type(error).__name__) from error
        return reply


def part_is_verified(reply: dict[str, Any], data: bytes, checksum: str) -> bool:
    """Whether the store's answer shows that it has these bytes; False where it says nothing. Raises DamagedError.

    checksum: SHA-256 in base64.
    """
    etag = str(reply["ETag"]).strip('"')
    is_plain = reply.get("ServerSideEncryption", "AES256") == "AES256" and not reply.get("SSECustomerAlgorithm")
    if is_plain and MD5.fullmatch(etag):
        if etag != hashlib.md5(data, usedforsecurity=False).hexdigest():
            raise DamagedError("a part arrived damaged; it is uploaded again")
        return True
    known = reply.get("ChecksumSHA256")
    if known and known != checksum:
        raise DamagedError("a part arrived damaged; it is uploaded again")
    return bool(known)


class _PacedSockets:
    """Makes the sockets of aiohttp's connections. The kernel spreads what they send, so there are no bursts."""

    def __init__(self, rate: int) -> None:
        self._rate = rate

    def __call__(self, address: tuple[Any, ...]) -> socket.socket:
        family, kind, protocol, *_ = address
        made = socket.socket(family, kind, protocol)
        made.setblocking(False)
        with suppress(OSError):  # the pace of parts holds without it
            made.setsockopt(socket.SOL_SOCKET, SO_MAX_PACING_RATE, self._rate)
        return made

    def __repr__(self) -> str:  # fsspec knows file systems by their options
        return f"_PacedSockets({self._rate})"
