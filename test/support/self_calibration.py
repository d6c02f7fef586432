"""Lens and shape of a board from a recording of it alone: an adjustment that shares nothing with the one under test.

The lens is OpenCV's with five coefficients, every corner of the board a point of its own, every frame a pose; poses are
eliminated frame by frame (Schur complement), residuals count less beyond three times their median.
"""

from dataclasses import dataclass

import cv2
import numpy as np

# fx fy cx cy k1 k2 p1 p2 k3.
_LENS = 9
# The residuals of the board change by less than a hundredth after the third.
_STEPS = 5
# Corners are where the board has them to this [m], which holds its place, its size and its plane. Noise of a corner
# [px].
_BOARD_STD, _CORNER_STD = 0.002, 0.2


@dataclass(frozen=True)
class Views:
    """What one camera saw of a board: for each frame indices (n,) of points and their pixels (n, 2)."""

    points: list[np.ndarray]
    pixels: list[np.ndarray]


@dataclass(frozen=True)
class Lens:
    """K (3, 3) and D (5,) of OpenCV."""

    K: np.ndarray
    D: np.ndarray

    def moved(self, step):
        """With other values of fx fy cx cy and the coefficients."""
        K = self.K.copy()
        K[[0, 1, 0, 1], [0, 1, 2, 2]] += step[:4]
        return Lens(K, self.D + step[4:])


def calibrate(views, lens, board, board_std=_BOARD_STD):
    """The lens and the board's points (P, 3) that fit best, from those that are given, near to the truth.

    The points are where they are given to ``board_std`` [m].
    """
    poses = [_pose(board[seen], pixels, lens) for seen, pixels in zip(views.points, views.pixels, strict=True)]
    start = board
    for _ in range(_STEPS):
        size = _LENS + board.size
        information, right, frames = np.zeros((size, size)), np.zeros(size), []
        # A prior for the mean place, size and direction is one for each point; it decides nothing else.
        information[range(_LENS, size), range(_LENS, size)] = (_CORNER_STD / board_std) ** 2
        right[_LENS:] = (_CORNER_STD / board_std) ** 2 * (start - board).ravel()
        for seen, pixels, pose in zip(views.points, views.pixels, poses, strict=True):
            r, by_pose, by_shared, places = _linearised(seen, pixels, pose, lens, board)
            H = np.linalg.inv(by_pose.T @ by_pose)
            cross = by_pose.T @ by_shared
            information[np.ix_(places, places)] += by_shared.T @ by_shared - cross.T @ H @ cross
            right[places] += by_shared.T @ r - cross.T @ (H @ (by_pose.T @ r))
            frames.append((H @ (by_pose.T @ r), H @ cross, places))
        step = np.linalg.solve(information, right)
        lens, board = lens.moved(step[:_LENS]), board + step[_LENS:].reshape(-1, 3)
        poses = [pose + own - by @ step[places] for pose, (own, by, places) in zip(poses, frames, strict=True)]
    return lens, board


def camera_poses(views, lens, board):
    """T_board_camera (F, 4, 4) of each frame by least squares."""
    result = np.tile(np.eye(4), (len(views.points), 1, 1))
    for T, seen, pixels in zip(result, views.points, views.pixels, strict=True):
        pose = _pose(board[seen], pixels, lens)
        R = cv2.Rodrigues(pose[:3])[0]
        T[:3, :3], T[:3, 3] = R.T, -R.T @ pose[3:]
    return result


def _pose(points, pixels, lens):
    """Rotation vector and translation (6,) of the board in the camera."""
    _, turn, shift = cv2.solvePnP(points, pixels, lens.K, lens.D, flags=cv2.SOLVEPNP_SQPNP)
    turn, shift = cv2.solvePnPRefineLM(points, pixels, lens.K, lens.D, turn, shift)
    return np.concatenate((turn.ravel(), shift.ravel()))


def _linearised(seen, pixels, pose, lens, board):
    """Weighted residuals (2 n,), derivatives by the pose (2 n, 6), by lens and points (2 n, 9 + 3 n), their places."""
    n = len(seen)
    predicted, J = cv2.projectPoints(board[seen], pose[:3], pose[3:], lens.K, lens.D)
    r = pixels - predicted.reshape(-1, 2)
    size = np.linalg.norm(r, axis=1)
    weight = np.repeat(np.minimum(1.0, 3.0 * np.median(size) / np.maximum(size, 1e-9)) ** 0.5, 2)
    by_points = np.zeros((n, 2, n, 3))
    by_points[range(n), :, range(n)] = J[:, 3:6].reshape(n, 2, 3) @ cv2.Rodrigues(pose[:3])[0]
    by_shared = np.concatenate((J[:, 6:15], by_points.reshape(2 * n, 3 * n)), axis=1)
    places = np.concatenate((np.arange(_LENS), (_LENS + 3 * seen[:, None] + np.arange(3)).ravel()))
    return weight * r.ravel(), weight[:, None] * J[:, :6], weight[:, None] * by_shared, places
