"""Calibrate two cameras with a plate of nine discs and measure a disc, in Python.

    python examples/two_cameras_and_a_plate.py

The images are those of ``closerange demo``; put your own folders in their place.
"""

from __future__ import annotations

from importlib.resources import as_file, files

import closerange as cr

CAMERAS = ("left", "right")


def main() -> None:
    """Run the example."""
    with as_file(files("closerange.workflows") / "demo_data") as data:
        plate = None
        for camera in CAMERAS:
            # one image a placement; the part of the file's name in brackets names it
            found = cr.detect(
                sorted((data / "calibration").glob(f"{camera}_*.png")),
                target=data / "plate.toml",
                camera=camera,
                placement_pattern="_(z.*)$",
            )
            plate = found if plate is None else plate + found
        rig = cr.calibrate(plate, control=data / "control.csv")
        print(rig.trust)

        # one disc, seen by both cameras in images that were cut out of the full frame
        disc = None
        for camera in CAMERAS:
            found = cr.detect(
                data / "verify" / f"p00_{camera}_r0.png",
                target=data / "disc.toml",
                camera=camera,
                placement="p00",
                crops=data / "verify" / "crops.csv",
            )
            disc = found if disc is None else disc + found
        position = cr.measure(rig, disc)
        x, y, z = position.xyz_mm[0]
        sx, sy, sz = (position.cov_mm2[0].diagonal() ** 0.5).tolist()
        print(f"X {x:.4f} +- {sx:.4f} mm   Y {y:.4f} +- {sy:.4f} mm   Z {z:.4f} +- {sz:.4f} mm")
        print("true: X 30.5003   Y 30.7941   Z 1.5326")


if __name__ == "__main__":
    main()
