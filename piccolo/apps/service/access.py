"""Who may ask the service, and by which addresses."""

from typing import NamedTuple
from urllib.parse import urlsplit

LOOPBACK = ("127.0.0.1", "localhost", "::1")


class Access(NamedTuple):
    """Who may ask, and by which addresses."""

    token: str | None  # which who asks must know; None lets all of this machine ask
    public_url: str | None = None  # of the page, behind a proxy; ends in /
    origins: tuple[str, ...] = ()  # whose pages may ask too

    @property
    def path(self) -> str:
        """The path of the page as browsers see it."""
        return urlsplit(self.public_url or "/").path

    @property
    def is_secure(self) -> bool:
        """True if browsers ask by HTTPS."""
        return (self.public_url or "").startswith("https:")
