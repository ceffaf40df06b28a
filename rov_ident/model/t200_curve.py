"""Thrust of a Blue Robotics T200 over the pulse width at several voltages, and its source.

Blue Robotics, "T200 Public Performance Data 10-20 V", September 2019: bollard thrust (at rest, in
still water) with the Basic ESC. Forward (positive) is where water enters at the nose cone.

The workbook itself was not at hand; the numbers come from copies of its sheets in public projects,
and each sheet has been compared with the ends and the dead band quoted by others:

* 10 V: the whole sheet (marus-core, ``T200.cs``), every tenth row; the others are met to 0.06 kgf.
* 12 V: a cubic fitted to the sheet (nsk126/AUVMEC), both ends as published (-28.6 and 36.4 N).
* 16 V: ten rows of the sheet, 1700 us as quoted elsewhere (1.82 kgf), and three small values out of
  a resampled copy (DukeRobotics, ``16.csv``).
* 14 V is not in the table: between 12 and 16 V its ends (-3.52 and 4.52 kgf) are met to 1 %.
* 18 V: the ends as published (-45.0 and 59.0 N), the shape of 16 V in between.

Against the maker's whole sheets the curves (14 V: interpolated) are off by 0.1 to 0.3 N rms and
1.3 N at most from 10 to 16 V, by 1.2 N rms and 3.0 N at most at 18 V (``test_inputs.py``). What the
water does to thrust at speed is larger.
"""

KILOGRAM_FORCE = 9.80665  # N

_AT_16 = {
    1100: -4.07, 1184: -2.94, 1308: -1.35, 1400: -0.45, 1440: -0.16, 1472: 0.0,
    1528: 0.0, 1560: 0.24, 1624: 0.87, 1700: 1.82, 1728: 2.22, 1840: 4.25, 1864: 4.71, 1900: 5.25,
}  # fmt: skip

CURVES: dict[float, dict[int, float]] = {
    10.0: {
        1100: -2.31, 1140: -2.04, 1180: -1.68, 1220: -1.36, 1260: -1.08, 1300: -0.80,
        1340: -0.55, 1380: -0.34, 1420: -0.15, 1456: -0.03, 1460: 0.0, 1540: 0.0, 1544: 0.04,
        1580: 0.18, 1620: 0.41, 1660: 0.70, 1700: 0.97, 1740: 1.36, 1780: 1.73, 1820: 2.12,
        1860: 2.58, 1900: 2.93,
    },
    12.0: {
        1100: -2.92, 1140: -2.55, 1180: -2.15, 1220: -1.74, 1260: -1.36, 1300: -1.02,
        1340: -0.72, 1380: -0.45, 1420: -0.22, 1464: 0.0, 1536: 0.0, 1580: 0.26, 1620: 0.56,
        1660: 0.89, 1700: 1.27, 1740: 1.70, 1780: 2.19, 1820: 2.72, 1860: 3.25, 1900: 3.71,
    },
    16.0: _AT_16,
    18.0: {pwm: f * (6.02 / 5.25 if f > 0.0 else 4.59 / 4.07) for pwm, f in _AT_16.items()},
}  # fmt: skip
"""Voltage [V] -> pulse width [us] -> thrust [kgf]."""
