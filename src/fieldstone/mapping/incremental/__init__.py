"""Incremental registration: from an initial pair, photo by photo.

`mapper` has the order of the steps. They take a `state.RegistrationState` and return the next:
`initialization` (which pair, and its first points), `view_selection` (which photo next), `registration` (its pose from
the points that it sees), `structureless` (from relative poses alone). `options` has the thresholds and the stages in
which they are relaxed, `checkpoint` keeps states between runs.
"""
