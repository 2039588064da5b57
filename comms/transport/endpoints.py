"""Endpoints such as `tcp/127.0.0.1:7447`: parsed, checked, and a free port found."""

from __future__ import annotations

import ipaddress
import re
import socket

from marl_sched.errors import DeploymentError, InvalidOptionError

_ENDPOINT = re.compile(r"(?P<protocol>tcp|tls)/(?P<host>[^\s/:]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})")


def check_endpoint(option: str, endpoint: str) -> tuple[str, int]:
    """(host, port) of an endpoint, or InvalidOptionError."""
    match = _ENDPOINT.fullmatch(endpoint)
    if match is None or int(match["port"]) > 65535:
        raise InvalidOptionError(f"{option}: expected an endpoint such as tcp/127.0.0.1:7447, got {endpoint!r}")
    return match["host"].strip("[]"), int(match["port"])


def is_loopback(endpoint: str) -> bool:
    """Whether only this machine can reach an endpoint."""
    host, _ = check_endpoint("listen", endpoint)
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:  # a host's name: it may stand for any address
        return False


def split_endpoints(endpoints: str) -> list[str]:
    """The endpoints of a list such as `tls/host-1:7447,tls/host-2:7447`, of which one that answers is enough."""
    return endpoints.split(",")


def is_encrypted(endpoints: str) -> bool:
    """Whether both sides show certificates; InvalidOptionError for endpoints of which only some do."""
    found = split_endpoints(endpoints)
    for endpoint in found:
        check_endpoint("endpoint", endpoint)
    encrypted = {endpoint.startswith("tls/") for endpoint in found}
    if len(encrypted) > 1:
        raise InvalidOptionError(f"endpoint: expected all of them on tls/ or none, got {endpoints}")
    return encrypted.pop()


def settle_port(endpoint: str) -> str:
    """The endpoint with a free port in place of port 0; DeploymentError if its port is in use or not ours to use."""
    host, port = check_endpoint("listen", endpoint)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise DeploymentError(f"cannot listen on {endpoint}: {error.strerror}") from error
        port = probe.getsockname()[1]
    return f"{endpoint.rsplit(':', 1)[0]}:{port}"
