"""Compiled kernels, which take and fill arrays and return codes instead of exceptions.

Conventions of lenses, motions, projections, maps and residuals:
`lens` is (13,): OpenCV's k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3 s4 and the squared undistorted radius where the radial part
folds; or (1, 14), where it may be a fisheye: then the last number is 1, and k1 k2 k3 k4 have the places of these names;
`axis` is the component of the image that the clock follows (1: rows, 0: columns) and `sign` its direction;
`model` is a code of `model.motion.SHUTTER_MODELS`; `intr` is (4,): fx fy cx cy; `phi` is (3,), or the table of a motion
that is not steady, see `motion.path`. Of several photos there is one more dimension.
"""
