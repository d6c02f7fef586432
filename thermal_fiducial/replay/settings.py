"""Parameters of a replay: those of the nodes from a ROS parameter file, checked before anything starts."""

from collections.abc import Iterator, Mapping
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import yaml

from thermal_fiducial.config import (
    ArucoDetectorConfig,
    check_names,
    for_whole_numbers,
    from_mapping,
    MarkerMapperConfig,
    NODES,
    OF_CAMERA,
    parameters,
    PoseEkfConfig,
    size_overrides,
    Tau2CameraConfig,
)
from thermal_fiducial.core.pipeline import PipelineConfig
from thermal_fiducial.errors import InputError
from thermal_fiducial.files.bad_pixel_list import load_bad_pixels
from thermal_fiducial.files.camera_info import load_camera
from thermal_fiducial.files.dictionary import load_dictionary, other_patterns
from thermal_fiducial.files.marker_map import load_map, other_frame, other_sides
from thermal_fiducial.files.parameter_sections import (
    as_in_file,
    joined,
    load_sections,
    mistyped_sections,
    values_for,
    values_of_others,
)
from thermal_fiducial.files.reading import naming
from thermal_fiducial.files.writing import write_text


@dataclass(frozen=True)
class Settings:
    """Complete and validated parameters of the four nodes."""

    tau2_camera: Tau2CameraConfig
    aruco_detector: ArucoDetectorConfig
    marker_mapper: MarkerMapperConfig
    pose_ekf: PoseEkfConfig
    #: front end and detector of a second camera, whose name the mapper's parameters have
    second: tuple[Tau2CameraConfig, ArucoDetectorConfig] | None = None
    #: dictionary of the map, as its file names it; empty without a map
    map_dictionary: str = ''
    #: warnings about usable but suspicious values
    warnings: tuple[str, ...] = ()

    def write(self, path: Path) -> None:
        """Write all parameters as a ROS parameter file. Raises InputError if the file cannot be written."""
        configs = {f'/{node}': getattr(self, node) for node in NODES}
        if self.second is not None:
            names = [f'/{self.marker_mapper.second_camera}/{node}' for node in OF_CAMERA]
            configs |= dict(zip(names, self.second, strict=True))
        document = {
            node: {'ros__parameters': {name: as_in_file(value) for name, _, value in parameters(config)}}
            for node, config in configs.items()
        }
        write_text(path, yaml.safe_dump(document, sort_keys=False))


def read_settings(params: Path | None, overrides: Mapping[str, Any], second_camera: str = '') -> Settings:
    """Settings from a ROS parameter file and ``overrides`` (name to value, for every node that has it).

    With the name of a ``second_camera`` also those of its nodes.

    Raises
    ------
    InputError
        An unreadable file, a parameter that no node has, a value of the wrong type or out of range, or an unusable file
        named by a parameter.
    """
    document = {} if params is None else load_sections(params)
    overrides = dict(overrides) | ({'second_camera': second_camera} if second_camera else {})
    for kind in NODES.values():
        # An option is not blamed on the file.
        from_mapping(kind, overrides)
    named = (section.get('second_camera') for section in (*document.values(), overrides))
    seconds = {str(name) for name in named if name}
    with nullcontext() if params is None else naming(params):
        configs = {node: _config(node, values_for(document, node, seconds), overrides) for node in NODES}
        settings = Settings(**configs)
        if second_camera:
            own = (_config(node, _values_for_second(node, document, second_camera), overrides) for node in OF_CAMERA)
            settings = replace(settings, second=tuple(own))
    map_dictionary, warnings = _check_files(settings)
    if document and not any(values_for(document, node, seconds) for node in NODES):
        warnings.append(f'{params}: nothing in it is for our nodes: it is for {", ".join(document)}')
    doubts = [line for _, line in mistyped_sections(document)]
    doubts += (line for node in NODES for line in values_of_others(document, node, seconds))
    warnings += [f'{params}: {doubt}' for doubt in (*doubts, *_whole_numbers(document))]
    return replace(settings, map_dictionary=map_dictionary, warnings=tuple(warnings))


def load_config(path: str | Path | None = None, **overrides: Any) -> PipelineConfig:
    """Parameters of the four stages.

    Parameters
    ----------
    path : ROS parameter file; None: the defaults
    overrides : name to value, which override the file

    Returns
    -------
    PipelineConfig
        A section a node, named like it: ``tau2_camera``, ``aruco_detector``, ``marker_mapper`` and ``pose_ekf``, with
        the parameters as attributes. :class:`Pipeline` takes the whole, a stage its section.

    Raises
    ------
    InputError
        As :func:`read_settings`.
    """
    settings = read_settings(None if path is None else Path(path), overrides)
    return PipelineConfig(settings.tau2_camera, settings.aruco_detector, settings.marker_mapper, settings.pose_ekf)


def _check_files(settings: Settings) -> tuple[str, list[str]]:
    """Validate files named by parameters: raises what a node would report as a fault.

    Returns
    -------
    Dictionary of the map, empty without a map; warnings of a node.
    """
    mapper = settings.marker_mapper
    dictionary = load_dictionary(settings.aruco_detector.dictionary)
    sizes = size_overrides(mapper.marker_size_overrides)
    for camera in (settings.tau2_camera, *(settings.second or ())[:1]):
        if camera.calibration_file:
            load_camera(camera.calibration_file)
        if camera.bad_pixel_file:
            load_bad_pixels(camera.bad_pixel_file)
    if mapper.map_file:
        marker_map = load_map(mapper.map_file, mapper.marker_size, sizes)
        foreign = sorted(set(marker_map.markers) - set(range(len(dictionary.bits))))
        if foreign:
            raise InputError(f'{mapper.map_file}: marker {foreign[0]} is not in {settings.aruco_detector.dictionary}')
        folder = Path(mapper.map_file).parent
        other = other_patterns(marker_map.markers, marker_map.dictionary, settings.aruco_detector.dictionary, folder)
        frame = other_frame(marker_map.frame_id, mapper.map_frame)
        sides = other_sides(marker_map, mapper.marker_size, sizes)
        return marker_map.dictionary, [f'{mapper.map_file}: {doubt}' for doubt in (other, frame, sides) if doubt]
    return '', []


def _whole_numbers(document: Mapping[str, Mapping[str, Any]]) -> Iterator[str]:
    """Doubts about whole numbers that ROS, which starts the nodes of a robot, does not take for others."""
    defaults = {name: default for kind in NODES.values() for name, _, default in parameters(kind)}
    ours = (values for pattern, values in document.items() if pattern.rsplit('/', 1)[-1] in ('**', '*', *NODES))
    for values in ours:
        for name, value in values.items():
            if name in defaults and (remedy := for_whole_numbers(value, defaults[name])):
                yield f'parameter {name}: on a robot {remedy}'


def _config(node: str, values: dict[str, Any], overrides: Mapping[str, Any]) -> Any:
    check_names(values | dict(overrides))
    return from_mapping(NODES[node], values | dict(overrides))


def _values_for_second(node: str, document: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, Any]:
    """Values of a node of the second camera ``name``: those in its namespace, and those for any namespace."""
    return joined(document, node, (section for section in document if {'**', name} & set(section.split('/'))))
