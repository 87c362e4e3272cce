"""Hosts with ports, and where a proxy shows the pages: read strictly, since requests name them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final
from urllib.parse import unquote, urlsplit

from deepaccident_devkit.errors import ConfigError

_HOST: Final = re.compile(r"([A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\])(?::([0-9]{1,5}))?")
_ROOT: Final = re.compile(r"(/[A-Za-z0-9._~!$&'()*+,=:@%-]+)*/?")
PORTS: Final = {"http": 80, "https": 443}
"""Scheme → its own port."""


@dataclass(frozen=True, slots=True)
class HostPort:
    """A host, in small letters and without brackets, and a port if there is one."""

    name: str
    port: int | None

    @classmethod
    def parse(cls, text: str) -> HostPort | None:
        """Read `localhost:8765`, `[::1]` and the like; None if it is malformed."""
        match = _HOST.fullmatch(text)
        if match is None or int(match[2] or 0) > 0xFFFF:
            return None
        name = match[1].lower()
        if name.startswith("["):
            try:
                name = str(ip_address(name[1:-1]))
            except ValueError:
                return None
        return cls(name, int(match[2]) if match[2] else None)

    def __str__(self) -> str:
        """Return it as it stands in an address."""
        name = f"[{self.name}]" if ":" in self.name else self.name
        return name if self.port is None else f"{name}:{self.port}"

    @property
    def is_address(self) -> bool:
        """Whether it is an IP address and no name."""
        try:
            ip_address(self.name)
        except ValueError:
            return False
        return True

    def is_at(self, scheme: str, other: HostPort) -> bool:
        """Whether both are the same to a scheme, whose own port can be left out."""
        usual = PORTS[scheme]
        return self.name == other.name and (self.port or usual) == (other.port or usual)


@dataclass(frozen=True, slots=True)
class RootPath:
    """Where a proxy shows the pages: nowhere else, below a path, or at a whole URL.

    Attributes:
        path: `/user/me/proxy/8000`, or nothing.
        scheme: `http` or `https` of a URL.
        place: host and port of a URL.
    """

    path: str = ""
    scheme: str = ""
    place: HostPort | None = None

    @classmethod
    def parse(cls, text: str) -> RootPath:
        """Read a path or a URL. Raises ConfigError."""
        try:
            parts = urlsplit(text)
        except ValueError:  # brackets that do not match
            parts = urlsplit("?")
        place = HostPort.parse(parts.netloc)
        if place is not None and parts.scheme in PORTS:
            whole = f"{parts.scheme}://{parts.netloc}{parts.path}"
        else:
            whole, place = parts.path, None
        if text != whole or not _ROOT.fullmatch(parts.path):
            raise ConfigError(
                "--root-path: expected a path such as /user/me/proxy/8000 or a URL such as "
                f"https://hub.example.org/user/me/proxy/8000, found {text!r}"
            )
        return cls(parts.path.rstrip("/"), parts.scheme, place)

    def __str__(self) -> str:
        """Return the path or the URL, without a slash at its end."""
        return self.path if self.place is None else f"{self.scheme}://{self.place}{self.path}"

    def below(self, path: str) -> str | None:
        """What of a request's path comes after this one; None if it does not begin with it, segment by segment."""
        own, given = self.path.split("/"), path.split("/")
        if not self.path or [*map(unquote, own)] != [*map(unquote, given[: len(own)])]:
            return None
        return "".join(f"/{segment}" for segment in given[len(own) :])
