"""The nodes: convert, one core call, publish. Run them with ``ros2 run thermal_fiducial NODE``.

A node works on one thread: small matrices and images of 640x512 gain nothing from more, and the nodes share few
cores. The limit is set before numpy and OpenCV read it at their import; a user's own value is kept.
"""

import os
from pathlib import Path
import signal
import sys

for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM'):
    os.environ.setdefault(_name, '1')

# A node stopped during its imports has nothing to save, so it ends silently (python -m, or its executable).
_started = (sys.argv or [''])[0]
if _started == '-m' or Path(__file__).with_name(f'{Path(_started).name}.py').is_file():
    signal.signal(signal.SIGINT, signal.SIG_DFL)
