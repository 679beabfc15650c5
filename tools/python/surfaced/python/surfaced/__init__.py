"""Names the surface a sensorised stylus is dragged over, by the kernel two-sample test.

`X` holds n recordings of one sensor: an array of shape (n, channels, samples), an array of shape
(n, samples) of one channel, or a list of arrays of shape (channels, samples) or (samples,), which may
differ in length. Samples are float32 or float64 in any unit, and are compared as float32. `rate_hz` is
the number of samples a second. Input that cannot be used is refused with a ValueError that says why.
"""

from ._arrays import Recordings, read_library, write_library
from ._classifier import SurfaceClassifier, load, save
from ._core import __version__
from ._statistics import Dependence, hsic, mmd, required_scan_s, t_star

__all__ = [
    "Dependence", "Recordings", "SurfaceClassifier", "__version__", "hsic", "load", "mmd",
    "read_library", "required_scan_s", "save", "t_star", "write_library",
]
