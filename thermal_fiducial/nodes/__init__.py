"""The nodes: convert, one core call, publish. Run them with ``ros2 run thermal_fiducial NODE``.

A node works on one thread. Matrices of a few rows and images of 640x512 gain nothing from more, and the nodes share
few cores; this is said before numpy and OpenCV are imported, as they read it then. A user's own value stands.
"""

import os
from pathlib import Path
import signal
import sys

for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM'):
    os.environ.setdefault(_name, '1')

# A node that is stopped while it still imports has nothing to save and nothing to say (python -m, or its executable).
_started = (sys.argv or [''])[0]
if _started == '-m' or Path(__file__).with_name(f'{Path(_started).name}.py').is_file():
    signal.signal(signal.SIGINT, signal.SIG_DFL)
