"""Methods kept only for comparison: one module each, following its source.

Methods that calibrate from known points have ``calibrate(xyz_mm, xy_px, sizes_px)``, whose second
and third arguments hold one entry a camera, and return an object with ``positions(xy_px)``.
Disc and corner methods take an image. Nothing here imports `closerange`: a peer that shared code
with the program would share its mistakes.
"""
