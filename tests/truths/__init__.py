"""Every physical and numerical claim of the program as a case with an independent truth: what
`isac-rt validate` runs."""

from truths.case import Case, Measured, Skipped, run_case

__all__ = ["Case", "Measured", "Skipped", "all_cases", "run_case"]


def all_cases(quick: bool = False) -> list[Case]:
    """All cases, or the quick selection, in the order of their groups."""
    from truths import (
        amplitude,
        cars,
        clutter,
        crosschecks,
        geometry,
        measured,
        moving,
        noise,
        receivers,
        signal,
        street,
        tracking,
    )
    from truths.case import cases_of

    modules = (
        geometry,
        amplitude,
        clutter,
        signal,
        noise,
        moving,
        receivers,
        tracking,
        measured,
        crosschecks,
        street,
        cars,
    )
    cases = [case for module in modules for case in cases_of(module)]
    return [case for case in cases if case.quick or not quick]
