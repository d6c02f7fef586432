"""A separate DDS domain, which isolates a replay from robots and other replays."""

from collections.abc import Iterator
from contextlib import contextmanager
import os
import socket

from thermal_fiducial.errors import InputError

#: Domains above 101 use Linux's ephemeral ports; 0 is the default domain.
_DOMAINS = range(1, 90)


@contextmanager
def own_domain() -> Iterator[int]:
    """Number of a domain that no other replay on this machine uses, nor the user, for as long as the context lasts.

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
            yield domain
            return
    raise InputError(f'all {len(_DOMAINS)} DDS domains for replays are in use on this machine')
