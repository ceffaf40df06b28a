"""What a simulation gets wrong, and why: the search for missing effects, offline and live.

`windowed_problem`, `multiple_shooting` and `linearisation` simulate a `hypothesis` over short
windows; `output_error` fits it; `selection` scores what may be added; `screening`, `patterns` and
`search` find it; `sensor_consistency` does the same for sensors. `held_out` and `findings` judge on
data that no fit has seen, and `certainty` says what else may have made what was found. `explain` is
the whole, and begins with `prepared` records. In a node, `live_windows` and `monitor` do the cheap
part.
"""
