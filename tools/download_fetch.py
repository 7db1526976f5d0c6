"""Archives in the user's cache: fetched by pooch, resumed by HTTP range, pinned by their checksum on first use."""

from __future__ import annotations

import json
import logging
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from trihedron.pipeline.core.errors import DataError, printable
from trihedron.pipeline.core.files import write_file

PINS = "pins.json"
CHUNK = 1 << 14  # what a broken connection loses at most
TIMEOUT_S = (20.0, 60.0)  # to connect, and between two packets
PARTIAL, WHOLE, BAD_RANGE = 206, 200, 416


@dataclass(frozen=True)
class Archive:
    """A file with the address it came from and its SHA-256. `cached` is false for a file of the user's own."""

    path: Path
    address: str
    sha256: str
    cached: bool


@dataclass(frozen=True)
class Cache:
    """Folder of archives, and the checksums of those used before (pins.json: address -> sha256, bytes, first)."""

    folder: Path

    @classmethod
    def of_user(cls) -> Cache:
        """Return the cache of this user, or of TRIHEDRON_DOWNLOADS."""
        import pooch

        given = os.environ.get("TRIHEDRON_DOWNLOADS")
        return cls(Path(given) if given else Path(pooch.os_cache("trihedron")) / "downloads")

    def fetch(self, address: str, limit: int, sha256: str = "", repin: bool = False) -> Archive:
        """Return the archive of an address or a file, fetched unless it is in the cache. `sha256` is the published checksum; without it the pinned
        one, unless `repin`, must be met. Raises DataError: unreachable, interrupted, more than `limit` bytes, changed."""
        import pooch
        import requests

        if "://" not in address:
            return self._own_file(Path(address).expanduser(), limit, sha256)
        if urlsplit(address).scheme not in ("http", "https"):
            raise DataError(address, "is not an address of the web", "give http://, https:// or a file")
        pin = {} if repin else self._pins().get(address, {})
        pooch.get_logger().setLevel(logging.WARNING)
        file = _file_name(address)
        try:
            path = pooch.retrieve(address, sha256 or pin.get("sha256"), file, self.folder, downloader=_Download(self.folder / f"{file}.part", limit))
        except ValueError as error:
            raise self._mismatch_error(address, sha256, pin, error) from error
        except requests.RequestException as error:
            raise DataError(
                address, f"cannot be fetched ({_reason(error)})", "check the network, or give --from with another address or file"
            ) from error
        return Archive(Path(path), address, pooch.file_hash(path), cached=True)

    def pin(self, archive: Archive) -> None:
        """Write down the checksum of an archive that was used."""
        if not archive.cached:
            return
        pins = self._pins()
        pins[archive.address] = {"sha256": archive.sha256, "bytes": archive.path.stat().st_size, "first": str(date.today())}
        written = self.folder / f"{PINS}.new"
        write_file(written, json.dumps(pins, indent=2, sort_keys=True) + "\n")
        written.replace(self.folder / PINS)

    def discard(self, archive: Archive) -> None:
        """Remove an archive from the cache; a file of the user's own stays."""
        if archive.cached:
            archive.path.unlink(missing_ok=True)

    def _pins(self) -> dict[str, Any]:
        path = self.folder / PINS
        try:
            found = json.loads(path.read_text()) if path.exists() else {}
            return {str(address): dict(pin) for address, pin in found.items()}
        except (ValueError, AttributeError, TypeError) as error:
            raise DataError(str(path), "is not a list of checksums", "remove it, then everything is pinned anew") from error

    def _own_file(self, path: Path, limit: int, sha256: str) -> Archive:
        import pooch

        if not path.is_file():
            raise DataError(str(path), "is not a file", "give an archive, or an address with http:// or https://")
        if path.stat().st_size > limit:
            raise _too_large(str(path), path.stat().st_size, limit)
        found = pooch.file_hash(str(path))
        if sha256 and found != sha256:
            raise DataError(str(path), f"has the SHA-256 {found[:12]}… instead of {sha256[:12]}…", "fetch the archive again")
        return Archive(path, str(path), found, cached=False)

    def _mismatch_error(self, address: str, sha256: str, pin: dict[str, Any], error: ValueError) -> DataError:
        if sha256:
            return DataError(address, f"the archive does not have the published SHA-256 {sha256[:12]}…", "do not use it; ask its publisher")
        if not pin:
            return DataError(address, f"cannot be fetched ({printable(str(error), 160)})", "give --from with another address or file")
        cause = f"the archive has changed since {pin.get('first', 'its first use')}: its SHA-256 is not the pinned {pin['sha256'][:12]}…"
        return DataError(address, cause, "give --repin if its publisher replaced it")


@dataclass(frozen=True)
class _Download:
    """Downloader for pooch: streams into `part` beside the cache's files, goes on from it by a range request, then moves it to its place."""

    part: Path
    limit: int

    def __call__(self, url: str, output_file: str | os.PathLike[str] | Any, _pooch: Any) -> None:
        import requests

        with requests.Session() as session:
            response = self._request(session, url)
            with response:
                self._stream(response, url)
        os.replace(self.part, output_file)
        self._validator.unlink(missing_ok=True)

    @property
    def _validator(self) -> Path:
        return self.part.with_suffix(".part.tag")

    def _request(self, session: Any, url: str) -> Any:
        """Ask for what is missing; for everything where the file on the server is another one than before, or the part is useless."""
        have, tag = self.part.stat().st_size if self.part.exists() else 0, ""
        with suppress(OSError):
            tag = self._validator.read_text()
        headers = {"Accept-Encoding": "identity"}
        if have and tag:
            response = session.get(url, headers=headers | {"Range": f"bytes={have}-", "If-Range": tag}, stream=True, timeout=TIMEOUT_S)
            if response.status_code == PARTIAL and response.headers.get("Content-Range", "").startswith(f"bytes {have}-"):
                return response
            if response.status_code == WHOLE:
                self.part.unlink()
                return response
            response.close()
        self.part.unlink(missing_ok=True)
        response = session.get(url, headers=headers, stream=True, timeout=TIMEOUT_S)
        response.raise_for_status()
        return response

    def _stream(self, response: Any, url: str) -> None:
        import requests
        from tqdm import tqdm

        have = self.part.stat().st_size if self.part.exists() else 0
        length = response.headers.get("Content-Length", "")
        total = have + int(length) if length.isdigit() else None
        if total is not None and total > self.limit:
            raise _too_large(url, total, self.limit)
        write_file(self._validator, response.headers.get("ETag") or response.headers.get("Last-Modified") or "")
        bar = tqdm(total=total, initial=have, unit="B", unit_scale=True, desc=_file_name(url)[:30], disable=None, file=sys.stderr)
        broken = ""
        with open(self.part, "ab", opener=_unlinked) as file, bar:
            try:
                for chunk in response.iter_content(CHUNK):
                    have += len(chunk)
                    if have > self.limit:
                        break
                    file.write(chunk)
                    bar.update(len(chunk))
            except (requests.exceptions.ChunkedEncodingError, requests.ConnectionError, requests.Timeout) as error:
                broken = _reason(error)
        if have > self.limit:
            self.part.unlink()
            raise _too_large(url, have, self.limit)
        have = self.part.stat().st_size
        if broken or (total is not None and have < total):
            of = f" of {total / 1e6:.1f}" if total is not None else ""
            raise DataError(url, f"the download was interrupted after {have / 1e6:.1f}{of} MB", "the same command again goes on from there")


def _unlinked(path: str, flags: int) -> int:
    """Open a file itself, not what a link in its place names."""
    return os.open(path, flags | os.O_NOFOLLOW, 0o666)


def _too_large(place: str, size: int, limit: int) -> DataError:
    return DataError(place, f"has {size / 1e9:.3g} GB, more than the {limit / 1e9:.3g} GB allowed", "give --max-gb N if that is right")


def _file_name(address: str) -> str:
    """Return a name in the cache: the address without its scheme, in letters that every file system knows."""
    parts = urlsplit(address)
    text = f"{parts.netloc}{parts.path}"
    return "".join(letter if letter.isalnum() or letter in ".-_" else "_" for letter in text)[-150:].lstrip(".")


def _reason(error: Exception) -> str:
    response = getattr(error, "response", None)
    if response is not None:
        return f"HTTP {response.status_code}"
    name = type(error).__name__
    return {"ConnectionError": "no connection", "ConnectTimeout": "no answer", "ReadTimeout": "no answer"}.get(name, name)
