"""Products of small matrices on the host, without the threads of NumPy's library: from a size on
these are called, and wait for one another longer than such a product takes.
"""

import numpy as np

__all__ = ["gram", "product", "rows_of"]

SINGLE_THREADED = 2**18  # multiplications up to which OpenBLAS uses one thread
LEAST_ROWS = 64  # of a block: larger matrices are worth the threads


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """``a`` [n, d] times ``b`` [d, m]."""
    rows = rows_of(len(a), b.size)
    if rows >= len(a):
        return a @ b
    out = np.empty((len(a), b.shape[1]), np.result_type(a, b))
    for i in range(0, len(a), rows):
        np.matmul(a[i : i + rows], b, out=out[i : i + rows])
    return out


def gram(a: np.ndarray, w: np.ndarray) -> np.ndarray:
    """The sum of w_i a_i a_i^T [d, d] over the rows of ``a`` [n, d]."""
    rows = rows_of(len(a), a.shape[1] ** 2)
    parts = (slice(i, i + rows) for i in range(0, len(a), rows))
    return sum((a[i].T * w[i]) @ a[i] for i in parts)


def rows_of(n: int, each: int) -> int:
    """Rows of a block of ``n``, where one takes ``each`` multiplications."""
    rows = SINGLE_THREADED // max(each, 1)
    return rows if rows >= LEAST_ROWS else max(n, 1)
