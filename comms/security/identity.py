"""Where a process finds the certificate by which it is known."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from marl_sched.errors import InvalidOptionError

AUTHORITY, WORLD, ROUTER, OBSERVER, OPERATOR = "ca", "world", "router", "observer", "operator"


@dataclass(frozen=True)
class Identity:
    """Where a process finds the authority's certificate, and its own with its private key.

    Attributes:
        folder: as `marl-sched certs` fills it.
        name: the common name, `world`, `router`, `observer`, `operator` or an agent's name.
    """

    folder: Path
    name: str

    def __post_init__(self) -> None:
        """Refuse a folder in which a file is missing."""
        for path in (self.authority, self.certificate, self.key):
            if not path.is_file():
                raise InvalidOptionError(
                    f"certs: {path}: there is no such file; `marl-sched certs --out DIR --agents ...` makes it"
                )

    @property
    def authority(self) -> Path:
        """The certificate of the authority that is trusted."""
        return self.folder / f"{AUTHORITY}.pem"

    @property
    def certificate(self) -> Path:
        """This process's certificate."""
        return self.folder / f"{self.name}.pem"

    @property
    def key(self) -> Path:
        """This process's private key."""
        return self.folder / f"{self.name}.key"
