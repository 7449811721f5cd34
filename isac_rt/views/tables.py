"""Tables of ready text: what a run's summary says, for the report and for the command line."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from isac_rt.results.losses import LOSSES
from isac_rt.results.recorder import TIMINGS
from isac_rt.results.sensing import FALSE_CAUSES
from isac_rt.scenario.tree import OWN

DASH = "\u2013"


@dataclass(frozen=True)
class Table:
    """Column titles and rows of ready text."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]


def number(value: Any, digits: int = 3) -> str:
    """Format a value; a dash for null and non-finite values."""
    if value is None or (isinstance(value, float) and value - value != 0):
        return DASH
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int) or float(value).is_integer():
        return f"{value:,.0f}"
    return f"{value:.{digits}g}" if abs(value) < 1e3 else f"{value:,.0f}"


LEGEND = {
    "SER delay": "SER, BER: share of the symbols or bits sent that were decided wrongly or erased.",
    "Erased": "Erased: share of the symbols not decided, or whose frame fails its check sum.",
    "Bit rate [kbit/s]": "Bit rate: payload of frames read over the run, pilots and pauses in.",
    "Misread": "Misread: frames read, with over half of their delay or DPSK symbols wrong.",
    "Late": "Late: data frames read after later ones had been received.",
    "In view": "In view: UAVs times frames in the field of view and not occluded.",
    "Found": "Found: share of those in view with a detection of their own path within one "
    "resolution cell on every axis.",
    "Tracked": "Tracked: share of those in view with a confirmed track within three resolution "
    "cells on every axis and 5 m.",
    "False tracks per frame": "False tracks: confirmed tracks that track no UAV, 5 m or more "
    "from every one.",
    "Noise only": "Noise only: mean detection probability of this kind of detector in noise alone, "
    "by one test in the target's direction; a search over directions finds less.",
    "Matched filter": "Matched filter: that of a filter at the true range, velocity and direction; "
    "no receiver finds more.",
    "Known clutter": "Known clutter: that of a detector in the target's cell that whitens the "
    "channels by the true scatterers.",
    "SNR [dB]": "SNR: mean of the matched filter. Windows, straddling, clutter: mean losses by "
    "Hann windows, between cells, and to clutter after whitening.",
    "False alarms": "False alarms: detections per frame that no path explains, at "
    "update_false_alarm_rate where that is set.",
    "GOSPA [m]": "GOSPA (p = 2, alpha = 2, c = 5 m): distance of the confirmed tracks from the "
    "targets; above \u201cNo tracks\u201d they are worse than none.",
    "n": "n: estimates caused by the UAV's own path within three resolution cells, the base of the "
    "RMSE.",
    "City loss": "City loss: noise-only detection probability less the share found. Other columns "
    "by cause: target-frames that were lost.",
    "Switches": "In view, found, tracked: frames; switches: to another track.",
    "Too weak": "Too weak: under 13 dB for a matched filter over samples, chirps and antennas.",
    "Not decoded": "Not decoded: the frame's data were erased or wrong.",
    "Inaccurate": "Inaccurate: over one resolution cell off.",
    "Noise": "Noise: below the threshold of a detector that adds the channels' powers.",
    "Masked": "Masked: by a stronger line of sight, mirror image, leakage or UAV.",
    "Clutter": "Clutter: over the noise in the cell, raising the threshold, or detected instead.",
    "Threshold": "Threshold: missed by chance.",
    "Diffuse": "Diffuse: walls, ground and roofs.",
    "Specular": "Specular: mirror images of the transmitter.",
    "Target": "Target: a diverged track of a UAV.",
    "Ghost": "Ghost: an echo of a UAV over a wall.",
    "Ghosts": "Ghosts: echoes of a UAV over the surface.",
    "Mirror images": "Mirror images: those of the transmitter.",
}
"""Meaning of a column title."""


def legend(*tables: Table, skip: Sequence[str] = ()) -> str:
    """Explain the columns of tables that have rows, each once, except those to `skip`."""
    shown = {title for table in tables if table.rows for title in table.columns}.difference(skip)
    return " ".join(text for title, text in LEGEND.items() if title in shown)


_RATES = {
    "SER delay": "ser_delay",
    "SER DPSK": "ser_dpsk",
    "BER": "ber",
    "Erased": "erased",
    "Bit rate [kbit/s]": "bit_rate_bps",
}

_FRAMES = {
    "Frames unread": "erased",
    "Misread": "misread",
    "Frames read": "read",
    "Late": "late",
    "Most frames late": "most",
}


def data_table(summary: Mapping[str, Any]) -> Table:
    """Decoding of the links that carry data; no rows where none does."""
    rows = [
        (
            link_words(name),
            *(number(s[key]) for key in list(_RATES.values())[:-1]),
            number(None if s["bit_rate_bps"] is None else s["bit_rate_bps"] / 1e3),
            *_waits(s.get("latency_frames")),
        )
        for name, s in summary["links"].items()
        if s["ser_delay"] is not None
    ]
    return Table(("Data", *_RATES, *_FRAMES), rows)


def _waits(latency: Mapping[str, Any] | None) -> list[str]:
    """Data frames of a link by what became of them."""
    return [number(None if latency is None else latency[key]) for key in _FRAMES.values()]


def _parts(
    summary: Mapping[str, Any], group: str
) -> Iterator[tuple[str, Mapping[str, Any], Mapping[str, Any]]]:
    """(link, its figures, those of the targets or of the terminals) where some were in view."""
    for name, s in summary["links"].items():
        part = s if group == "targets" else s.get("cooperative", {})
        if part.get("in_view"):
            yield link_words(name), s, part


_FOUND = {"In view": "in_view", "Found": "hit_rate", "Tracked": "tracked_rate"}
_GOSPA = {"GOSPA [m]": "total_m", "No tracks [m]": "no_tracks_m"}
_FALSE = "False tracks per frame"
_SCORE = (*_FOUND, _FALSE, *_GOSPA)


def _score(part: Mapping[str, Any]) -> list[str]:
    """Targets found and tracked, false tracks, and GOSPA."""
    values = [*(part[key] for key in _FOUND.values()), part["false_tracks_per_frame"]]
    return [number(v) for v in (*values, *(part["gospa"][key] for key in _GOSPA.values()))]


def hit_table(summary: Mapping[str, Any], group: str) -> Table:
    """Tabulate the shares of ``targets`` or ``terminals`` found and tracked by link; for targets
    also false tracks and GOSPA, of links and of fused tracks."""
    titles = _SCORE if group == "targets" else _SCORE[: len(_FOUND)]
    parts: list[tuple[str, Mapping[str, Any]]] = [
        (link, {**s, **part}) for link, s, part in _parts(summary, group)
    ]
    if group == "targets":
        parts += [(f"{name}, fused", p) for name, p in _fused(summary) if p.get("in_view")]
    rows = [(name, *_score(part)[: len(titles)]) for name, part in parts]
    return Table((group.capitalize(), *titles), rows)


def bound_table(summary: Mapping[str, Any], group: str) -> Table:
    """Tabulate the share of ``targets`` or ``terminals`` found by link, its bounds, and SNR."""
    titles = ("Matched filter", "Noise only", "Known clutter", "Found", "False alarms")
    losses = ("SNR [dB]", "Windows [dB]", "Straddling [dB]", "Clutter [dB]")
    rows = []
    for link, s, part in _parts(summary, group):
        found = *part["bounds"].values(), part["hit_rate"], s["false_per_frame"]
        levels = (None if level is None else round(level, 2) for level in part["snr_db"].values())
        rows.append((link, *map(number, (*found, *levels))))
    return Table((f"Detection of {group}", *titles, *losses), rows)


def rmse_table(summary: Mapping[str, Any], group: str) -> Table:
    """RMSE of the detections and of the tracks of ``targets`` or ``terminals``, by link."""
    rows = [
        (
            f"{link}, {estimates}s",
            number(round(part[share] * part["in_view"])),
            *(number(v) for v in part[key].values()),
        )
        for link, _, part in _parts(summary, group)
        for estimates, share, key in (
            ("detection", "matched", "rmse"),
            ("track", "matched_tracked", "rmse_tracked"),
        )
    ]
    return Table((f"RMSE of {group}", "n", *_AXES), rows)


def side_by_side(summary: Mapping[str, Any]) -> Table:
    """The scenario's own receivers and those compared with them on the same samples, link by link;
    no rows where none are compared."""
    titles = list(_RATES)[:4]
    costs = summary["timing_s"].get("by_set", {})
    rows = []
    for name, set_name, link in _sets(summary):
        rates = [number(link[_RATES[title]]) for title in titles]
        values = (*rates, *_score(link), number(costs[set_name][name]))
        rows.append((link_words(name), set_name, *values))
    return Table(("Link", "Receivers", *titles, *_SCORE, "Processor time [s]"), rows)


def _sets(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(link, set of receivers, figures) where several sets received the same samples."""
    sets = {OWN: summary, **summary.get("compared", {})}
    for link in summary["links"]:
        for name, figures in sets.items():
            known = name in summary["timing_s"].get("by_set", {})
            if known and "tracked_rate" in figures["links"][link]:
                yield link, name, figures["links"][link]


_CITY = ("ghost", "specular", "diffuse")
"""Kinds of paths that there would be none of without a city."""


def city_costs(summary: Mapping[str, Any]) -> Table:
    """Tabulate the targets that each set of receivers loses to the city, and the false tracks that
    the city causes; no rows where none are compared."""
    causes = {"Masked": "masked", "Clutter": "clutter", "Not decoded": "erased"}
    rows = []
    for link, name, figures in _sets(summary):
        noise_only, hits = figures["bounds"]["clutter_free"], figures["hit_rate"]
        if hits is None or noise_only is None:
            continue
        values = (
            figures["in_view"],
            hits,
            noise_only,
            round(noise_only - hits, 3),
            *(figures["losses"][cause] for cause in causes.values()),
            sum(figures["false_tracks"][kind] or 0.0 for kind in _CITY),
            figures["ser_delay"],
        )
        rows.append((link_words(link), name, *map(number, values)))
    titles = ("In view", "Found", "Noise only", "City loss", *causes)
    ends = ("False tracks of the city", "SER delay")
    return Table(("Link", "Receivers", *titles, *ends), rows)


def link_words(name: str) -> str:
    """AT to PT1, of AT->PT1."""
    return name.replace("->", " to ")


_COVERAGE = {
    "Max range [m]": "max_range_m",
    "Range cell [m]": "range_resolution_m",
    "Max velocity [m/s]": "max_velocity_mps",
    "Velocity cell [m/s]": "velocity_resolution_mps",
    "Azimuth beam [deg]": "azimuth_resolution_deg",
    "Elevation beam [deg]": "elevation_resolution_deg",
    "Field of view [deg]": "field_of_view_deg",
    "Bit rate [kbit/s]": "bit_rate_bps",
}
_OUTSIDE = ("out_of_view", "beyond_range", "too_near", "too_fast")


def _filled(table: Table) -> Table:
    """A table without its columns of dashes alone."""
    columns = zip(table.columns, *table.rows, strict=True)
    filled = [column for column in columns if set(column[1:]) != {DASH}]
    titles, *rows = zip(*filled, strict=True)
    return Table(titles, rows)


def coverage_tables(seen: Mapping[str, Any]) -> tuple[Table, str, Table]:
    """Tabulate the coverage of the radar: a row for the links of equal limits, an explanation with
    the times, and the frames in which UAVs are outside.

    Parameters
    ----------
    seen : `isac_rt.simulation.coverage.Coverage` as a mapping
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    for of in seen["links"]:
        rate = of["bit_rate_bps"]
        row = {**of, "bit_rate_bps": None if rate is None else rate / 1e3}
        alike.setdefault(tuple(number(row[key]) for key in _COVERAGE.values()), []).append(
            link_words(of["link"])
        )
    rows = [(", ".join(names), *row) for row, names in alike.items()]
    limits = _filled(Table(("Coverage", *_COVERAGE), rows))
    farthest = max(seen["links"], key=lambda of: of["max_range_m"])
    chirps: dict[str, list[str]] = {}
    for of in seen["links"]:
        slot, frame = number(of["slot_s"] * 1e6), number(of["frame_s"] * 1e3)
        chirps.setdefault(f"{slot} us, a frame {frame} ms", []).append(link_words(of["link"]))
    durations = " or ".join(
        f"{lasts} ({', '.join(links)})" if len(chirps) > 1 else lasts
        for lasts, links in chirps.items()
    )
    interval = number(seen["frame_interval_s"] * 1e3)
    bistatic = any(len(set(of["link"].split("->"))) > 1 for of in seen["links"])
    length = ", path length between two terminals" if bistatic else ""
    past = ""
    if farthest["filtered_range_m"] > farthest["max_range_m"]:
        past = "; echoes from up to twice the maximum range disturb some chirps"
    words = (
        f"A slot (one chirp of each group) lasts {durations}, and one starts "
        f"every {interval} ms. Range: one way for echoes{length}{past}. "
        "Faster UAVs alias in velocity. Beam: width of the array's main lobe at boresight. Field "
        "of view: to each side; directions are unambiguous to "
        f"{number(farthest['unambiguous_angle_deg'])} deg. Occlusion is not considered here."
    )
    rows = [
        (
            f"{row['uav']} on {link_words(row['link'])}",
            *(f"{row[key]}" for key in (*_OUTSIDE, "frames")),
        )
        for row in seen["outside"]
    ]
    titles = (
        "Frames outside",
        "Field of view",
        "Beyond range",
        "Too near",
        "Too fast",
        "Of frames",
    )
    return limits, words, Table(titles, rows)


def _fused(summary: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """(name, figures) of the fused tracks, those of the whole swarm first."""
    if swarm := summary.get("swarm"):
        yield "Whole swarm", swarm
        yield from swarm["terminals"].items()


def swarm_table(summary: Mapping[str, Any]) -> Table:
    """The fused tracks of cooperating terminals, those of the whole swarm first; no rows where none
    cooperate."""
    rows = [
        (
            name,
            *(number(p["rmse"][key]) for key in ("position_m", "velocity_mps")),
            number(p["nees"]),
            *(number(p[key]) for key in ("reports_per_frame", "age_s")),
            *_traffic(p, "terminals" not in p),
        )
        for name, p in _fused(summary)
    ]
    errors = ("Position [m]", "Velocity [m/s]", "NEES")
    reports = ("Reports per frame", "Age [s]", "Left out", "kbit sent", "Lost messages")
    return Table(("Fused tracks", *errors, *reports), rows)


def _traffic(fused: Mapping[str, Any], receives: bool) -> tuple[str, str, str]:
    """Count what the messages to a terminal left out, their bits and the capacity of its links, and
    lost messages."""
    if not receives:
        return DASH, DASH, DASH
    bits = f"{number(fused['bits'] / 1e3)} of {number(fused['bits_capacity'] / 1e3)}"
    lost = f"{fused['messages_lost']} of {fused['messages']}"
    return number(fused["left_out"]), bits, lost


def false_table(summary: Mapping[str, Any]) -> Table:
    """Tabulate the false tracks per frame of each link by cause, without causes that do not occur,
    and the tracks of objects, which are none; no rows without either."""
    links = {name: s for name, s in summary["links"].items() if "false_tracks" in s}
    causes = [c for c in FALSE_CAUSES if any(s["false_tracks"][c] for s in links.values())]
    moving = {name: s.get("object_tracks_per_frame") for name, s in links.items()}
    extra = ["Tracks of objects"] if any(moving.values()) else []
    rows = [
        (
            link_words(name),
            *map(number, (s["false_tracks_per_frame"], *map(s["false_tracks"].get, causes))),
            *(number(moving[name]) for _ in extra),
        )
        for name, s in links.items()
        if causes or extra
    ]
    titles = (cause.replace("_", " ").capitalize() for cause in causes)
    return Table((_FALSE, "All", *titles, *extra), rows)


def _uavs(summary: Mapping[str, Any], group: str) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(link, UAV, figures) of the ``targets`` or ``terminals`` that were in view at some time; in a
    swarm of terminals alone these are the targets."""
    every = [(link, s.get("targets", {})) for link, s in summary["links"].items()]
    ends = {end for link, _ in every for end in link.split("->")}
    terminals = ends if {uav for _, of in every for uav in of} - ends else set()
    for link, of in every:
        for uav, t in of.items():
            if t["in_view"] and (uav in terminals) == (group == "terminals"):
                yield link_words(link), uav, t


def target_table(summary: Mapping[str, Any], group: str) -> Table:
    """Tabulate the frames in which each UAV of a group was in view, found and tracked."""
    keys = ("in_view", "found", "tracked", "switches")
    rows = [(link, u, *(number(t[key]) for key in keys)) for link, u, t in _uavs(summary, group)]
    return Table(("Link", "UAV", "In view", "Found", "Tracked", "Switches"), rows)


def error_table(summary: Mapping[str, Any], group: str) -> Table:
    """Median and 90 % of the errors of each UAV of a group, and the Cramer-Rao bound of both; UAVs
    that were never found are left out."""
    rows = []
    for link, uav, t in _uavs(summary, group):
        if any(middle is not None for middle in t["median"].values()):
            rows.append(
                (link, uav, "error", number(t.get("detected")), *_pairs(t["median"], t["p90"]))
            )
            if "bound_median" in t:
                rows.append((link, uav, "bound", "", *_pairs(t["bound_median"], t["bound_p90"])))
    return Table(("Link", "UAV", "", "n", *_AXES), rows)


_AXES = ("Range [m]", "Velocity [m/s]", "Azimuth [deg]", "Elevation [deg]")


def _pairs(middle: Mapping[str, float | None], most: Mapping[str, float | None]) -> list[str]:
    """Median / 90 % on each axis."""
    return [
        DASH if value is None else f"{number(value, 2)} / {number(most[key], 2)}"
        for key, value in middle.items()
    ]


def loss_table(summary: Mapping[str, Any], group: str) -> Table:
    """Tabulate the outcome of every target-frame in view; causes without frames are left out."""
    rows = list(_uavs(summary, group))
    causes = [c for c in LOSSES if any(t["losses"][c] for _, _, t in rows)]
    words = ("not decoded" if cause == "erased" else cause for cause in causes)
    titles = (cause.replace("_", " ").capitalize() for cause in words)
    return Table(
        ("Link", "UAV", *titles),
        [(link, uav, *(number(t["losses"][c]) for c in causes)) for link, uav, t in rows],
    )


def flat(tree: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Leaves of a nested mapping as (dotted name, text)."""
    out: list[tuple[str, str]] = []
    for key, value in tree.items():
        name = f"{prefix}{key}".replace("_", " ")
        if isinstance(value, Mapping):
            out += flat(value, f"{name}: ")
        else:
            values = value if isinstance(value, list | tuple) else [value]
            out.append((name, ", ".join(map(number, values))))
    return out


def row_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Rows of one shape as a table, keys as titles."""
    if not rows:
        return Table((), ())
    return Table([_title(k) for k in rows[0]], [[number(v) for v in row.values()] for row in rows])


_UNITS = {"_dbm": " [dBm]", "_db": " [dB]", "_m": " [m]", "_s_per_m": " [S/m]"}


def _title(key: str) -> str:
    """A key as a column title, its unit in brackets."""
    ending = next((e for e in sorted(_UNITS, key=len, reverse=True) if key.endswith(e)), "")
    words = key.removesuffix(ending).replace("_", " ").replace("snr", "SNR")
    return words[:1].upper() + words[1:] + _UNITS.get(ending, "")


def timing_table(seconds: Mapping[str, Any]) -> Table:
    """Processor and wall seconds of every stage; runs of earlier versions have the former alone."""
    wall = seconds.get("wall", {})
    rows = [
        (stage, number(seconds[stage]), number(wall.get(stage)))
        for stage in TIMINGS
        if stage in seconds and stage != "wall"
    ]
    return Table(("Stage", "Processor [s]", "Wall [s]"), rows)
