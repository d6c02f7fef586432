"""Checks that the autopilot's topic has one publisher and a subscriber."""

from typing import TYPE_CHECKING

from thermal_fiducial.report.bridge_check import Finding, Level

if TYPE_CHECKING:
    # Recordings are also checked without ROS.
    from thermal_fiducial.ros.watching.bridge_listener import Links


def check_links(links: 'Links') -> list[Finding]:
    """Findings on a running graph of nodes; an error reported by the filter comes first."""
    findings = []
    if links.complaint:
        text = 'There is nothing to fly on, or nothing is sent, whatever else is in order.'
        findings.append(Finding('filter', Level.FAULT, f'pose_ekf says: {links.complaint}', text))
    if links.senders > 1:
        seen = f'{links.senders} nodes send the odometry'
        findings.append(Finding('senders', Level.FAULT, seen, 'The autopilot gets a mixture; only one may.'))
    seen = f'{links.receivers} listen to {links.topic}'
    if links.receivers:
        return [*findings, Finding('receivers', Level.OK, seen, '')]
    text = 'Is mavros running with its odometry plugin, or for PX4 the Micro XRCE-DDS agent?'
    return [*findings, Finding('receivers', Level.WARNING, seen, text)]
