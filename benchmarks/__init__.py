import os
import time

# before NumPy is imported: its matrices are small here, and threads only wait for one another
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
BEGUN = time.perf_counter()  # when this process imported its first benchmark
