"""Plot the poses of a run: ``python plot_run.py RUN OUT.png``. ``thermal-fiducial replay`` wrote the folder RUN."""

from pathlib import Path
import sys

from matplotlib.figure import Figure

from thermal_fiducial.files.trajectory_file import load_tum


def main(run: str, out: str) -> None:
    """Position over time: fused, and of the markers alone."""
    figure = Figure(figsize=(9.0, 6.0), layout='constrained')
    axes = figure.subplots(3, sharex=True)
    trajectories = {name: load_tum(Path(run) / f'{name}.tum') for name in ('fiducial', 'fused')}
    start = min(stamps[0] for stamps, _, _ in trajectories.values())
    for name, style in (('fiducial', '.'), ('fused', '-')):
        stamps, positions, _ = trajectories[name]
        for axis, values in zip(axes, positions.T, strict=True):
            axis.plot((stamps - start) * 1e-9, values, style, label=name, markersize=3.0, linewidth=1.0)
    for axis, letter in zip(axes, 'xyz', strict=True):
        axis.set_ylabel(f'{letter} [m]')
        axis.grid(alpha=0.3)
    axes[0].legend()
    axes[-1].set_xlabel('time [s]')
    figure.savefig(out)


if __name__ == '__main__':
    if len(sys.argv) != 3:
        sys.exit('usage: python plot_run.py RUN OUT.png')
    main(*sys.argv[1:])
