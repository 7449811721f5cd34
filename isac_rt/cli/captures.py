"""Commands on measured samples: `import`, `calibrate` and `receive`."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from isac_rt.cli.arguments import InputProblem
from isac_rt.cli.console import Report, say, say_table, with_progress, working

if TYPE_CHECKING:
    import xarray as xr

    from isac_rt.extensions.hardware.types import Capture

DescriptionFile = Annotated[
    Path | None,
    typer.Option(
        "--description",
        metavar="FILE",
        help="Settings of the board that the file does not hold: YAML, or TI's .cfg or "
        ".mmwave.json.",
    ),
]
Format = Annotated[
    str | None,
    typer.Option(
        "--format",
        metavar="NAME",
        help="ti_calibration, dca1000, numpy or sigmf.",
        show_default="by suffix",
    ),
]
CalibrationFile = Annotated[
    Path | None,
    typer.Option("--calibration", metavar="CAL", help="Calibration of the board to apply."),
]
KEYS = (
    "range_m range_scatter_mm rank_one_share residual_db residual_deg gain_spread_rx_db "
    "gain_spread_tx_db unexplained_db unexplained_response_db range_bound_mm snr_db"
).split()
STDOUT = "-"


def with_standard_output(arguments: list[str]) -> list[str]:
    """`calibrate --json` without a file means standard output."""
    if arguments[:1] != ["calibrate"]:
        return arguments
    out: list[str] = []
    for word, after in zip(arguments, [*arguments[1:], "--"], strict=True):
        out.append(word)
        if word == "--json" and after.startswith("--"):
            out.append(STDOUT)
    return out


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Samples of a radar board.")],
    out: Annotated[Path, typer.Option(metavar="CUBE.nc", help="Cube to write.")],
    description: DescriptionFile = None,
    format: Format = None,
    calibration: CalibrationFile = None,
) -> None:
    """Convert the file of a radar board into a cube of IF samples. Reads TI's calibration (.mat),
    DCA1000 (.bin), NumPy (.npy) and SigMF."""
    from isac_rt.extensions.hardware.store import load_capture, save_capture
    from isac_rt.results.files import check_folder

    check_folder(out.parent)
    with working("reading the samples"):
        capture = _calibrated(_imported(file, description, format), calibration)
        save_capture(capture, out)
        again = load_capture(out)
    if (again.cube.samples != capture.cube.samples).any():
        raise InputProblem(f"{out}: does not read back as it was written; is the disk sound?")
    say(f"{out}: {capture.cube!r}")


def calibrate(
    cube: Annotated[
        Path | None,
        typer.Argument(metavar="CUBE", help="A cube, or a file that `import` reads by itself."),
    ] = None,
    out: Annotated[Path | None, typer.Option(metavar="CAL", help="Calibration to write.")] = None,
    json_file: Annotated[
        str | None,
        typer.Option(
            "--json", metavar="[FILE]", help="Write the result as JSON; without FILE print it."
        ),
    ] = None,
    description: DescriptionFile = None,
    azimuth_deg: Annotated[
        float,
        typer.Option(min=-89, max=89, help="Azimuth of the reflector from boresight, in degrees."),
    ] = 0.0,
    elevation_deg: Annotated[
        float, typer.Option(min=-89, max=89, help="Elevation of the reflector, in degrees.")
    ] = 0.0,
) -> None:
    """Calibrate a board with one strong reflector. Estimates gains, phases, delays and the response
    over the sweep."""
    from isac_rt.extensions.hardware.calibrate import calibrate as fit
    from isac_rt.extensions.hardware.calibrate import save_calibration
    from isac_rt.extensions.hardware.explain import STEPS, unexplained_by
    from isac_rt.results.files import check_folder
    from isac_rt.storage import write_whole

    if cube is None and json_file not in (None, STDOUT):  # `--json CUBE`
        cube, json_file = Path(str(json_file)), STDOUT
    if cube is None:
        raise InputProblem("calibrate: which CUBE? name the file")
    for target in (out, json_file):
        if target not in (None, STDOUT):
            check_folder(Path(str(target)).parent)
    azimuth, elevation = math.radians(azimuth_deg), math.radians(elevation_deg)
    cosines = math.cos(elevation) * math.sin(azimuth), math.sin(elevation)
    with working("fitting"):
        capture = _opened(cube, description)
        calibration = fit(capture, cosines)
        left = {}
        if capture.antennas is not None and cosines == (0, 0):
            left = dict(
                zip(STEPS, unexplained_by(capture, calibration, list(STEPS.values())), strict=True)
            )
    figures: dict[str, Any] = {name: getattr(calibration, name) for name in KEYS}
    figures |= {"unexplained_by_db": left} | _per_channel(calibration)
    text = json.dumps(figures, indent=1, allow_nan=False) + "\n"
    if out is not None:
        save_calibration(calibration, out)
    if json_file == STDOUT:
        typer.echo(text, nl=False)
        return
    if json_file is not None:
        write_whole(Path(json_file), text)
    say_table(("", cube.name), [(name, f"{figures[name]:.4f}") for name in KEYS])
    if left:
        rows = [(name, f"{level:.2f}") for name, level in left.items()]
        say_table(("simulated with the board's", "unexplained [dB]"), rows)
    say(*([f"{out}: name it with --calibration"] if out is not None else []))


def _per_channel(board: Any) -> dict[str, Any]:
    """Gains, phases, delays and the sweep as lists, with their standard deviations."""
    import numpy as np

    out: dict[str, Any] = {}
    for end in ("rx", "tx"):
        gain, spread = getattr(board, f"{end}_gain"), getattr(board, f"{end}_gain_std")
        delay, std = getattr(board, f"{end}_delay"), getattr(board, f"{end}_delay_std")
        out[end] = {
            "gain_db": (20 * np.log10(np.abs(gain))).tolist(),
            "gain_std_db": (20 / math.log(10) / math.sqrt(2) * spread).tolist(),
            "phase_deg": np.rad2deg(np.angle(gain)).tolist(),
            "phase_std_deg": np.rad2deg(spread / math.sqrt(2)).tolist(),
            "delay_ps": (delay * 1e12).tolist(),
            "delay_std_ps": (std * 1e12).tolist(),
        }
    frequency, response, spread = board.sweep
    out["sweep"] = {
        "frequency_hz": frequency.real.tolist(),
        "gain_db": (20 * np.log10(np.abs(response))).tolist(),
        "phase_deg": np.rad2deg(np.angle(response)).tolist(),
        "relative_std": spread.real.tolist(),
    }
    return out


def receive(
    cube: Annotated[
        Path, typer.Argument(metavar="CUBE", help="A cube, or a file that `import` reads.")
    ],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the results.")],
    calibration: CalibrationFile = None,
    description: DescriptionFile = None,
    receivers: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="YAML with keys of a scenario's `receivers`.",
            show_default="defaults of the scenario",
        ),
    ] = None,
) -> None:
    """Detect and track targets in measured samples, all frames of a file, with the active receiver.
    Writes detections, tracks, and the last frame's range-Doppler and range-azimuth maps."""
    import numpy as np

    from isac_rt.document import Document
    from isac_rt.extensions.hardware.sense import range_azimuth, sense_all
    from isac_rt.receive.settings import Receivers
    from isac_rt.results.files import check_folder, write_dataset, write_figure
    from isac_rt.track.settings import Tracking
    from isac_rt.views.measured import drawn

    settings = Receivers()
    if receivers is not None:
        settings = Document(receivers, "state keys of `receivers`").check(Receivers)
    check_folder(out)
    captures, interval = _recorded(cube, description, calibration)

    def work(report: Report) -> xr.Dataset:
        return sense_all(captures, settings, Tracking(), interval, report)

    dataset = with_progress(work, "frames", len(captures))
    with working("drawing"):
        write_dataset(dataset, out / "reception.nc")
        last = dataset.isel(detection=dataset.det_frame.values == len(captures) - 1)
        write_figure(out / "range_doppler.png", drawn(dataset.map_power, last))
        view, capture = np.deg2rad(np.linspace(-60, 60, 241)), captures[-1]
        farthest = float(dataset.map_range[-1]) / (2 if capture.one_sided else 1)
        write_figure(out / "range_azimuth.png", drawn(range_azimuth(capture, view, farthest)))
    confirmed = np.unique(dataset.track_id.values[dataset.track_confirmed.values])
    message = f"{dataset.sizes['detection']} detections in {len(captures)} frames"
    if len(captures) > 1:
        message += f", {len(confirmed)} confirmed tracks"
        if interval is None:
            message += "; state frame_interval_ms in the description for tracks"
    say(message)
    say(f"in {out}: reception.nc, range_doppler.png, range_azimuth.png")


def _recorded(
    file: Path, description: Path | None, calibration: Path | None
) -> tuple[Sequence[Capture], float | None]:
    """Frames of a file with a board's calibration applied, and the time between them [s]."""
    from isac_rt.extensions.hardware.calibrate import apply, load_calibration
    from isac_rt.extensions.hardware.description import load_description
    from isac_rt.extensions.hardware.readers import Frames, import_frames

    if not _is_imported(file, description):
        return [_calibrated(_opened(file, description), calibration)], None
    described = None if description is None else load_description(description)
    with working("reading the samples"):
        frames = import_frames(file, described)
    interval = None
    if described is not None and described.frame_interval_ms is not None:
        interval = described.frame_interval_ms * 1e-3
    if calibration is None:
        return frames, interval
    corrections = load_calibration(calibration)
    return Frames(len(frames), lambda k: apply(corrections, frames[k])), interval


def _imported(file: Path, description: Path | None, format: str | None) -> Capture:
    from isac_rt.extensions.hardware.description import load_description
    from isac_rt.extensions.hardware.readers import FORMATS, import_file

    if format is not None and format not in FORMATS:
        raise InputProblem(f"--format {format}: choose from {', '.join(FORMATS)}")
    return import_file(file, None if description is None else load_description(description), format)


def _opened(file: Path, description: Path | None) -> Capture:
    """A cube that `import` wrote, or what `import` would make of a board's file."""
    from isac_rt.extensions.hardware.store import load_capture

    if _is_imported(file, description):
        return _imported(file, description, None)
    return load_capture(file)


def _is_imported(file: Path, description: Path | None) -> bool:
    from isac_rt.extensions.hardware.readers import SUFFIXES

    return file.suffix in SUFFIXES or description is not None


def _calibrated(capture: Capture, calibration: Path | None) -> Capture:
    from isac_rt.extensions.hardware.calibrate import apply, load_calibration

    return capture if calibration is None else apply(load_calibration(calibration), capture)
