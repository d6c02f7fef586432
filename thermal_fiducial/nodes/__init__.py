"""The nodes: convert, one core call, publish. Run them with ``ros2 run thermal_fiducial NODE``.

A node works on one thread. Matrices of a few rows and images of 640x512 gain nothing from more, and the nodes share
few cores; this is said before numpy and OpenCV are imported, as they read it then. A user's own value stands.
"""

import os

for _name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS', 'MKL_NUM_THREADS', 'OPENCV_FOR_THREADS_NUM'):
    os.environ.setdefault(_name, '1')
