"""Lifted matrices, full searches and differences, against which faster ways are tested."""

import numpy as np
import scipy.linalg
import scipy.signal


def lifted(model, N, C=None):
    """Return the matrix (N n_y, N n_u) from u[0..N-1] to y[1..N], one impulse after the other.

    model: its A, B and C are constant or of each sample, C then of the sample after
    C: of other outputs of the same state; None: those of the model
    """
    C = model.C if C is None else C
    A, B, C = (np.broadcast_to(M, (N, *np.shape(M)[-2:])) for M in (model.A, model.B, C))
    H = np.zeros((N, C.shape[1], N, B.shape[2]))
    for k in range(N):
        X = B[k]
        for i in range(k, N):
            X = A[i] @ X if i > k else X
            H[i, :, k] = C[i] @ X
    return H.reshape(N * C.shape[1], -1)


def lifted_difference(a, b, N):
    """Return the matrix (N, N) from u to y[1..N], by SciPy's filter of a difference equation."""
    h = scipy.signal.lfilter(b, [1.0, *np.negative(a)], np.eye(N)[0])
    return scipy.linalg.toeplitz(h, np.zeros(N))


def distances(points, path):
    """Return the least distance of each point from the chords, each at three candidates."""
    a, b = path[:-1], path[1:]
    away = points[:, None] - a
    foot = np.sum(away * (b - a), axis=-1) / np.sum((b - a) ** 2, axis=-1)
    nearest = np.clip(foot, 0, 1)[..., None] * (b - a)
    ends = (away, points[:, None] - b, away - nearest)
    return np.min([np.linalg.norm(end, axis=-1) for end in ends], axis=(0, 2))


def derivatives(signal, dt):
    """Return the first three differences of a sampled signal that is at rest before and after."""
    held = np.pad(signal, ((3, 3), (0, 0)), mode="edge")
    return [np.diff(held, i, axis=0) / dt**i for i in (1, 2, 3)]


def relative(found, expected):
    """Return the largest difference as a share of the largest number that is expected."""
    return np.max(np.abs(np.asarray(found) - expected)) / np.max(np.abs(expected))
