"""Simulation of a Tau 2 and an IMU by their physics, independent of the code under test.

Frames with their ground truth, without files::

    from thermal_fiducial.sim.thermal_camera import render_frames, simulate_imu
    from thermal_fiducial.sim.scenario import named, SCENARIOS, with_contrast, with_lens

    for frame in render_frames('wall', seconds=12, seed=3):
        frame.stamp_ns, frame.counts          # uint16 (512, 640)
        frame.T_map_camera                    # (4, 4), true, at the stamp
        frame.corners_px                      # {id: (4, 2)} true raw (distorted) pixels, of markers wholly in view
        frame.shutter                         # the shutter is closed: counts are frozen, or show the shutter

    imu = simulate_imu('wall', seconds=12, seed=3)   # imu.stamps_ns, imu.angular_velocity, imu.linear_acceleration

``seconds`` is the length of the whole flight (take-off to landing, 11 s at least); ``start`` and ``stop`` pick frames
of it, ``noise=False`` switches noise, fixed pattern, bad pixels and shutter off, and
``quality=Quality(samples=97)`` (of :mod:`.render`) samples finely. A scenario is a frozen dataclass:
``dataclasses.replace(named('wall'), sensor=replace(named('wall').sensor, lag=0.0), fog=Fog(0.3))``. It has ``.lens``
(``.matrix``, ``.model``, ``.distortion``, ``.width``, ``.height``), ``.markers`` (``.id``, ``.size``,
``.T_map_marker``, ``.corners_map``), ``.T_body_camera``, ``.dictionary``, ``.trajectory(seconds, seed)``, ``.sensor``.
"""
