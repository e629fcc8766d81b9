"""What the figures were measured with: versions, processor, and how repeatable its times are."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version

import cv2
import numpy as np

from closerange.rig.calibrate import calibrate_rig
from closerange.verification.scenes import control_grid, observe, rig_b
from closerange.version import __version__
from peer_tables.table import timed

LIBRARIES = ("numpy", "scipy", "opencv-python-headless", "mrcal", "pycolmap")


def versions() -> str:
    """Name the program, the libraries and the machine."""
    parts = [f"closerange {__version__}", f"Python {platform.python_version()}"]
    for name in LIBRARIES:
        try:
            parts.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            parts.append(f"{name} not installed")
    threads = f"{os.cpu_count()} processors, {cv2.getNumThreads()} OpenCV threads"
    return ", ".join([*parts, f"{platform.machine()}, {threads}"])


class NoiseMeter:
    """Times one and the same calibration now and then, to see how far times can be trusted."""

    def __init__(self) -> None:
        scene = rig_b()
        self._control = control_grid(27)
        rng = np.random.default_rng(0)
        self._seen = observe(scene.cameras, self._control, noise_px=scene.noise_px, rng=rng)
        self._sizes = {camera.name: camera.size_px for camera in scene.cameras}
        self._blocks: list[list[float]] = []
        self._work()  # warm up

    def _work(self) -> None:
        calibrate_rig(self._seen, self._control, self._sizes, model="brown")

    def sample(self, times: int = 10) -> None:
        """Time the calibration a few times."""
        self._blocks.append([timed(self._work)[0] for _ in range(times)])

    def __str__(self) -> str:
        every = 1000 * np.concatenate(self._blocks)
        low, high = np.percentile(every, [10, 90])
        medians = ", ".join(f"{1000 * np.median(block):.1f}" for block in self._blocks)
        return (
            f"Machine noise: one and the same calibration took {np.median(every):.1f} ms (median), "
            f"10-90 % {low:.1f}-{high:.1f} ms; medians before and after each comparison: "
            f"{medians} ms."
        )
