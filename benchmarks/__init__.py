"""Speed against error, method by method, in units of one floor that is measured in the same run.

Every stage has a module with ``rows(quick: bool) -> list[dict[str, object]]``: `synthesis`,
`moving`, `reception`, `tracing`, `clutter`, `endtoend`, `datasets` and `hermes`. One that needs
what may not be installed also has ``missing() -> str | None``, which says why it is left out; one
that leaves out some of its methods has ``left_out() -> dict[str, str]``, reasons by method;
`endtoend` also has ``commands(quick)``, the parts of whole commands (`command.tables`). A row is
one method at one size, with these keys:

kind : str
    The stage, a key of `STAGES`' values.
method : str
    One curve of a figure: a method with its setting, such as "gridded, width 6".
size : int
    What grows along the curve, K: paths (synthesis, reception), scatterers (clutter), traced UAVs,
    triangles or frames (tracing, end to end), samples (data sets). `unit` says which.
error : float or None
    Relative RMS error against the oracle, or what `error_of` names; 0 for the oracle, None where
    the row has no error to speak of.
cost : float
    CPU time in floors: median of several, over `floor_s` of the same run.
floor_s : float
    The floor [CPU s]: one cube of the job filled once and transformed once by `scipy.fft` in
    complex64.

and, where they say something: seconds (median [s]), unit (of `size`), error_of (what `error` is),
oracle (bool, True for the reference), job (what is measured, in words), also (what else was
measured, in words).

Import only what a stage needs: none of the modules here is imported with the package.
"""

from __future__ import annotations

REQUIRED = ("kind", "method", "size", "error", "cost", "floor_s")
"""Keys of every row."""
STAGES = {
    "synthesis": "synthesis",
    "moving": "moving",
    "receive": "reception",
    "trace": "tracing",
    "clutter": "clutter",
    "end-to-end": "endtoend",
    "dataset": "datasets",
    "hermespy": "hermes",
}
"""The stages by their name on the command line, with the module (and kind) of each."""
