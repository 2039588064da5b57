"""A certificate authority of one's own, and a certificate for every process of a run.

A folder of certificates holds `ca.pem` and, for each name, `<name>.pem` and `<name>.key`; `ca.key` stays where the
certificates are made. The certificate's common name is what the world's access rules go by: `world`, `observer`, or an
agent's name such as `crew_3`. Only the certificates of the world and of routers can be a server's, so no agent can
listen in their place.
Private keys are readable by their owner alone. P-256, SHA-256; nothing can be revoked but by a new authority.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import re
from collections.abc import Sequence
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from marl_sched.comms.security.identity import AUTHORITY, OBSERVER, OPERATOR, ROUTER, WORLD
from marl_sched.errors import InvalidFileError, InvalidOptionError

LOOPBACK = ("127.0.0.1", "::1", "localhost")
DAYS = 365  # for which certificates are valid
_NAME = re.compile(r"[A-Za-z0-9_.-]{1,64}")


def make_certificates(folder: Path, names: Sequence[str], *, hosts: Sequence[str] = (), days: int = DAYS) -> list[str]:
    """Certificates for `names`, `world`, `router`, `observer` and `operator`, signed by the folder's authority.

    The authority is made if there is none.

    `hosts` are further addresses or names by which agents reach the world; those of loopback are always in its
    certificate. A certificate that is there already stays as it is. The names of those that were made.
    Raises InvalidOptionError for a name that cannot be one, InvalidFileError for an authority that cannot be read.
    """
    for name in names:
        if not _NAME.fullmatch(name) or name == AUTHORITY:
            raise InvalidOptionError(
                f"agents: expected names of 1 to 64 letters, digits, '.', '_' or '-', got {name!r}"
            )
    if days < 1:
        raise InvalidOptionError(f"days: expected at least 1 day, got {days}")
    addresses = [_address(host) for host in dict.fromkeys((*LOOPBACK, *hosts))]
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    authority = _Authority.load(folder) if (folder / f"{AUTHORITY}.pem").exists() else _Authority.make(folder, days)
    made = []
    for name in dict.fromkeys((WORLD, ROUTER, OBSERVER, OPERATOR, *names)):
        if (folder / f"{name}.pem").exists():
            continue
        authority.issue(folder, name, addresses if name in (WORLD, ROUTER) else [], days)
        made.append(name)
    return made


def agent_names(text: str) -> list[str]:
    """The names in a list such as `crew_0,crew_2` or `crew_0..crew_6`; InvalidOptionError for anything else."""
    names: list[str] = []
    for part in filter(None, text.split(",")):
        match = re.fullmatch(r"(.+_)(\d{1,6})\.\.(?:(.+_))?(\d{1,6})", part)
        if match is None:
            names.append(part)
        elif match[3] not in (None, match[1]) or int(match[4]) < int(match[2]):
            raise InvalidOptionError(f"agents: expected a range such as crew_0..crew_6, got {part!r}")
        else:
            names += [f"{match[1]}{i}" for i in range(int(match[2]), int(match[4]) + 1)]
    if not names:
        raise InvalidOptionError("agents: expected names such as crew_0,crew_1 or crew_0..crew_6, got none")
    return names


def _address(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        if not re.fullmatch(r"[A-Za-z0-9.-]{1,253}", host):
            raise InvalidOptionError(f"host: expected an address or a host's name, got {host!r}") from None
        return x509.DNSName(host)


class _Authority:
    """A certificate that signs others, and its key."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self._certificate, self._key = certificate, key

    @classmethod
    def load(cls, folder: Path) -> _Authority:
        """The authority of a folder; InvalidFileError if it cannot be read."""
        path = folder / f"{AUTHORITY}.key"
        try:
            certificate = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.pem").read_bytes())
            key = load_pem_private_key(path.read_bytes(), password=None)
        except (OSError, ValueError) as error:
            raise InvalidFileError(path, "", f"the authority's private key ({error})", None) from error
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise InvalidFileError(path, "", "a key of an elliptic curve", type(key).__name__)
        return cls(certificate, key)

    @classmethod
    def make(cls, folder: Path, days: int) -> _Authority:
        """A new authority, written to its folder."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _common_name("marl_sched authority")
        certificate = (
            _builder(name, name, key.public_key(), days)
            .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
            .add_extension(_key_usage(signs=True), critical=True)
            .sign(key, hashes.SHA256())
        )
        _write(folder, AUTHORITY, certificate, key)
        return cls(certificate, key)

    def issue(self, folder: Path, name: str, served: Sequence[x509.GeneralName], days: int) -> None:
        """A certificate and its key, written to the folder: a client's; with addresses `served` a server's too."""
        usages = [ExtendedKeyUsageOID.CLIENT_AUTH, *[ExtendedKeyUsageOID.SERVER_AUTH] * bool(served)]
        alternative = x509.SubjectAlternativeName(served or [x509.DNSName(name.replace("_", "-"))])
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = (
            _builder(_common_name(name), self._certificate.subject, key.public_key(), days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_key_usage(signs=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(usages), critical=False)
            .add_extension(alternative, critical=False)
            .sign(self._key, hashes.SHA256())
        )
        _write(folder, name, certificate, key)


def _common_name(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _key_usage(*, signs: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs,
        key_cert_sign=signs,
        crl_sign=signs,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, public_key: ec.EllipticCurvePublicKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public_key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - datetime.timedelta(days=1))  # clocks of a plant's hosts differ
        .not_valid_after(now + datetime.timedelta(days=days))
    )


def _write(folder: Path, name: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    secret = key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())
    for path, content, mode in (
        (folder / f"{name}.key", secret, 0o600),
        (folder / f"{name}.pem", certificate.public_bytes(Encoding.PEM), 0o644),
    ):
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, mode), "wb") as file:
            file.write(content)
