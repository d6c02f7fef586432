"""Quality of service of the topics.

Sensor inputs are best effort, which matches any publisher; what we publish is reliable. The IMU's queue holds half a
second or more, so a stall of the process loses no sample.
"""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy


def _profile(depth: int, *, reliable: bool = True, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


#: subscription to images and camera_info of any publisher. Of images that had to wait the detector takes the newest;
#: the front end needs those before it for the lag tail. DDS keeps the memory of as many as were ever queued
CAMERA_INPUT = _profile(3, reliable=False)
#: subscription that processes only the newest image; two show how many have been replaced
IMAGE_INPUT = _profile(2, reliable=False)
#: subscription to the IMU of any publisher
IMU_INPUT = _profile(400, reliable=False)
#: our images
IMAGE_OUTPUT = _profile(5)
#: results at frame rate, and subscriptions to them
RESULT = _profile(30)
#: results of which each has all that the last one had: DDS keeps the memory of as many as ever waited for a slow reader
NEWEST_RESULT = _profile(1)
#: results at IMU rate
IMU_RATE_RESULT = _profile(400)
#: /tf_static: transient local, deep enough for several publishers
STATIC_TF = _profile(100, latched=True)
#: transient local, for late subscribers: the map
LATCHED = _profile(1, latched=True)
