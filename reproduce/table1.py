"""Table I: resolution and range of every sensing parameter, the paper's formulas beside what its
own settings give.

The paper's formulas are written out here with the paper's symbols and the paper's settings; the
other column comes from `Waveform` and `Antennas`.
"""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from isac_rt.frame.antennas import Antennas
from isac_rt.frame.waveform import SPEED_OF_LIGHT, Waveform
from reproduce.outcome import Judgement, Outcome, Progress, Verdict, blank, style

SPACING_WAVELENGTHS = 0.5774
_EXACT, _CARRIER = 1e-9, 6e-3
"""Agreement asked for: rounding, and the 0.44 % between f_c and the frequency at the middle of the
sampled window."""


def run(quick: bool, seed: int, progress: Progress) -> Outcome:
    """Every entry of Table I by formula; nothing is random and `quick` changes nothing."""
    rows = [row for terminal in ("AT", "PT") for row in entries(Waveform(), terminal)]
    progress(1, 1)
    settings = {"quick": quick, "seed": seed, "spacing_wavelengths": SPACING_WAVELENGTHS}
    verdicts = tuple(_verdict(row) for row in rows)
    tables, figure = {"table1": pd.DataFrame(rows)}, _figure(rows, verdicts)
    return Outcome("table1", "Table I", tables, figure, verdicts, settings)


def _figure(rows: list[dict], verdicts: tuple[Verdict, ...]) -> Figure:
    """The table with both columns of values, coloured by verdict."""
    colours = {"holds": "#DDF2E9", "holds under a condition": "#FFF3D6", "does not hold": "#F9DCD3"}
    cells = [
        [r["terminal"], r["quantity"], *(f"{r[x]:.6g}" for x in ("paper", "ours")), r["unit"]]
        for r in rows
    ]
    cells = [[*cell, v.verdict] for cell, v in zip(cells, verdicts, strict=True)]
    with style():
        figure, axes = blank(size=(8.2, 5.0))
        axes[0, 0].axis("off")
        table = axes[0, 0].table(
            cells,
            colLabels=["terminal", "quantity", "paper", "settings", "unit", "verdict"],
            cellLoc="left",
            loc="center",
            colWidths=[0.1, 0.34, 0.14, 0.14, 0.06, 0.22],
            cellColours=[[colours[v.verdict]] * 6 for v in verdicts],
        )
        table.auto_set_font_size(False)
        table.set_fontsize(8)
        table.scale(1, 1.25)
    return figure


def entries(w: Waveform, terminal: str) -> list[dict]:
    """Rows of one terminal: the paper's value, this program's, the relative agreement asked for,
    and why they differ."""
    c, f_c, f_s, b, passes = (
        SPEED_OF_LIGHT,
        w.carrier_frequency,
        w.sampling_rate,
        w.bandwidth,
        2 if terminal == "AT" else 1,
    )
    big_t, chirp, slot, frame = (
        w.sampled_duration,
        w.chirp_duration,
        w.slot_duration,
        w.frame_duration,
    )
    usable = c * w.max_delay / passes / 2
    array = Antennas(tx_x=2, tx_z=2, rx_x=8, rx_z=8, spacing=SPACING_WAVELENGTHS * w.wavelength)
    elements = {
        "elevation": array.rx_z * (array.tx_z if passes == 2 else 1),
        "azimuth": array.rx_x * (array.tx_x if passes == 2 else 1),
    }

    def row(
        quantity: str, unit: str, paper: float, ours: float, tolerance: float, note: str
    ) -> dict:
        return {
            "terminal": terminal,
            "quantity": quantity,
            "unit": unit,
            "paper": paper,
            "ours": ours,
            "tolerance": tolerance,
            "note": note,
        }

    half = (
        "half of the band is the data's; without data the limit is c T_d, T_d = f_s T~/B, over "
        "the passes, twice this"
    )
    middle = "Doppler is counted at the middle of the sampled window, 77.34 GHz, not at f_c"
    out = [
        row(
            "range resolution",
            "m",
            c * chirp / (passes * b * big_t),
            w.range_cell(passes),
            _EXACT,
            "600 MHz of the 640 are sampled",
        ),
        row(
            "range, first expression",
            "m",
            c * big_t * f_s / (passes * (b - f_s)),
            usable,
            _EXACT,
            f"it belongs to T~ = T + T_d; {half}",
        ),
        row(
            "range, second expression",
            "m",
            c * (chirp - big_t) / passes,
            usable,
            _EXACT,
            f"T~ - T is 2 T_d here; {half}",
        ),
        row(
            "velocity resolution",
            "m/s",
            c / (passes * frame * f_c),
            w.velocity_cell(passes),
            _CARRIER,
            middle,
        ),
        row(
            "velocity range",
            "m/s",
            c / (2 * passes * slot * f_c),
            w.max_velocity(passes),
            _CARRIER,
            middle,
        ),
    ]
    limit = 1 / (2 * SPACING_WAVELENGTHS)
    for angle, count in elements.items():
        printed, aperture = (
            (16 if passes == 2 else 8) * SPACING_WAVELENGTHS,
            count * array.spacing / w.wavelength,
        )
        out += [
            row(
                f"{angle} resolution at broadside",
                "1",
                1 / printed,
                1 / aperture,
                _EXACT,
                "in the sine; azimuth needs the X sizes, which happen to equal the printed Z sizes",
            ),
            row(
                f"{angle} range",
                "1",
                np.sin(np.pi / 3),
                limit,
                1e-3,
                "the sine of 60 degrees; exactly 60 degrees is ambiguous",
            ),
        ]
    return out


def _verdict(row: dict) -> Verdict:
    error = abs(row["paper"] / row["ours"] - 1)
    judged: Judgement = "does not hold" if error > row["tolerance"] else "holds"
    if judged == "holds" and error > _EXACT:
        judged = "holds under a condition"
    text = f"paper {row['paper']:.6g}, settings {row['ours']:.6g} {row['unit']} ({row['note']})"
    return Verdict(f"{row['terminal']} {row['quantity']}", judged, text)
