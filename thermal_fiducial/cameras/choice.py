"""Choice of the driver by a camera's name."""

from thermal_fiducial.cameras.capture import STALLED_S
from thermal_fiducial.cameras.pictures import Pictures
from thermal_fiducial.cameras.source import FrameSource
from thermal_fiducial.cameras.teax import ThermalGrabber
from thermal_fiducial.cameras.v4l2 import is_video_device, V4l2Camera
from thermal_fiducial.config import ThermalSourceConfig
from thermal_fiducial.errors import InputError

_TEAX = 'teax'
#: Default rate of recorded pictures [Hz], that of a Tau 2.
_PICTURE_RATE = 30.0


def make_source(config: ThermalSourceConfig) -> FrameSource:
    """The driver of ``config.camera``, not yet opened.

    Raises
    ------
    InputError
        No camera is named, or pictures that are not there.
    """
    kind, _, detail = config.camera.partition(':')
    size = (config.image_width, config.image_height) if config.image_width and config.image_height else None
    if bool(config.image_width) != bool(config.image_height):
        raise InputError('parameters image_width and image_height: both or none')
    if not config.camera:
        raise InputError('parameter camera: a device (/dev/video0), "teax", or a folder, picture or video')
    if kind == _TEAX:
        return ThermalGrabber(detail, size)
    if is_video_device(config.camera):
        return V4l2Camera(config.camera, size, config.frame_rate)
    return Pictures(config.camera, config.frame_rate or _PICTURE_RATE, repeat=config.repeat)


def longest_silence(config: ThermalSourceConfig) -> float:
    """Silence that counts as a loss of the camera [s]: at a slow rate that of a lost frame does not."""
    return max(STALLED_S, 3.0 / config.frame_rate) if config.frame_rate else STALLED_S


def unused_parameters(config: ThermalSourceConfig) -> list[str]:
    """A line for each parameter that was changed from its default and that the driver of ``config.camera`` lacks."""
    if config.camera.partition(':')[0] == _TEAX:
        unused: tuple[str, ...] = ('frame_rate', 'repeat')
    elif is_video_device(config.camera):
        unused = ('repeat',)
    else:
        unused = ('image_width', 'image_height')
    changed = [name for name in unused if getattr(config, name) != getattr(ThermalSourceConfig, name)]
    return [f'parameter {name}: no effect with camera {config.camera}' for name in changed] if config.camera else []
