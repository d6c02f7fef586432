"""A separate DDS domain, which isolates a replay from robots and other replays."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
import socket

from thermal_fiducial.errors import InputError

#: Domains above 101 use Linux's ephemeral ports; 0 is the default domain.
_DOMAINS = range(1, 90)
#: UDP ports of domain 0, and how many each domain has (DDSI-RTPS 2.5, 9.6.2.3).
_FIRST_PORT, _PORTS = 7400, 250


@contextmanager
def own_domain() -> Iterator[int]:
    """Number of a domain that nobody on this machine uses, and no other replay, for as long as the context lasts.

    Discovery is restricted to this machine, for this process and those that it starts.

    Raises
    ------
    InputError
        All domains are in use.
    """
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    # That of the environment: the user's robot may be flying in it.
    of_user = os.environ.get('ROS_DOMAIN_ID')
    for domain in (domain for domain in _DOMAINS if str(domain) != of_user):
        with socket.socket(socket.AF_UNIX) as claim:
            try:
                # An abstract name, no file: the same for all who could hear each other, and gone with the process.
                claim.bind(f'\0thermal_fiducial_domain_{domain}')
            except OSError:
                continue
            if _is_silent(domain):
                yield domain
                return
    raise InputError(f'all {len(_DOMAINS)} DDS domains for replays are in use on this machine')


def _is_silent(domain: int) -> bool:
    """Whether no program of this machine, such as the nodes of a robot, listens to any of a domain's ports."""
    first = _FIRST_PORT + domain * _PORTS
    for port in range(first, first + _PORTS):
        with socket.socket(type=socket.SOCK_DGRAM) as listener:
            try:
                listener.bind(('', port))
            except OSError:
                return False
    return True
