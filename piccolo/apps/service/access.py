"""Access to the service: who may send requests, and to which addresses."""

from typing import NamedTuple
from urllib.parse import urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Access(NamedTuple):
    """Who may send requests, and to which addresses."""

    token: str | None  # that a request must have; None: any request from this machine is answered
    public_url: str | None = None  # address of the page behind a proxy; ends in /
    origins: tuple[str, ...] = ()  # other sites whose pages may send requests

    @property
    def path(self) -> str:
        """The path of the page as browsers see it."""
        return urlsplit(self.public_url or "/").path

    @property
    def is_secure(self) -> bool:
        """True if browsers reach the page by HTTPS."""
        return (self.public_url or "").startswith("https:")
