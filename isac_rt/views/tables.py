"""Tables of ready text: what a run's summary says, for the report and for the command line."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
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
    """A value as people read it; null and what is not finite are a dash."""
    if value is None or (isinstance(value, float) and value - value != 0):
        return DASH
    if isinstance(value, bool | str):
        return str(value)
    if isinstance(value, int) or float(value).is_integer():
        return f"{value:,.0f}"
    return f"{value:.{digits}g}" if abs(value) < 1e4 else f"{value:,.0f}"


_RATES = {
    "SER delay": "ser_delay",
    "SER DPSK": "ser_dpsk",
    "BER": "ber",
    "Undecided": "erased",
    "Bits": "bits",
    "Bit rate [kbit/s]": "bit_rate_bps",
    "Hit rate": "hit_rate",
    "Matched": "matched",
    "Matched, tracked": "matched_tracked",
    "False per frame": "false_per_frame",
}


def _rates(link: Mapping[str, Any], keys: Iterable[str]) -> list[str]:
    """Figures of a link as text."""
    values = {key: link[key] for key in keys}
    if values.get("bit_rate_bps") is not None:
        values["bit_rate_bps"] /= 1e3
    return [number(value) for value in values.values()]


def per_terminal(summary: Mapping[str, Any]) -> Table:
    """Decoding and detection, one row for each link (and so for each terminal); what none of them
    has, a sensor's data say, has no column."""
    rows = [
        (link_words(name), s["role"], *_rates(s, _RATES.values()), *_waits(s.get("latency_frames")))
        for name, s in summary["links"].items()
    ]
    titles = ("Link", "Role", *_RATES, "Data frames read", "Of these late", "Frames late, at most")
    columns = zip(*rows, strict=True)
    kept = [set(column) != {DASH} for column in columns]
    return Table(tuple(compress(titles, kept)), [tuple(compress(row, kept)) for row in rows])


def _waits(latency: Mapping[str, Any] | None) -> list[str]:
    """Data frames of a link that were read, late ones among them, and by how much."""
    return [number(None if latency is None else latency[key]) for key in ("read", "late", "most")]


def side_by_side(summary: Mapping[str, Any]) -> Table:
    """The scenario's own receivers and those compared with them on the same samples, link by link;
    no rows where none are compared."""
    titles = {t: k for t, k in _RATES.items() if k not in ("bits", "bit_rate_bps")}
    titles["False tracks per frame"] = "false_tracks_per_frame"
    costs = summary["timing_s"].get("by_set", {})
    rows = [
        (
            link_words(name),
            set_name,
            *_rates(link, titles.values()),
            number(link["gospa"]["total_m"]),
            number(costs[set_name][name]),
        )
        for name, set_name, link in _sets(summary)
    ]
    return Table(("Link", "Receivers", *titles, "GOSPA [m]", "Processor time [s]"), rows)


def _sets(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(link, set of receivers, figures) where several sets heard the same samples."""
    sets = {OWN: summary, **summary.get("compared", {})}
    for link in summary["links"]:
        for name, one in sets.items():
            if name in summary["timing_s"].get("by_set", {}):
                yield link, name, one["links"][link]


_CITY = ("ghost", "specular", "diffuse")
"""Kinds of paths that there would be none of without a city."""


def city_costs(summary: Mapping[str, Any]) -> Table:
    """Tabulate what the city costs each set of receivers: what it finds, what it would find in
    noise alone, what hides the rest, and what the city makes it believe; no rows where none are
    compared."""
    causes = {"Masked": "masked", "Clutter": "clutter", "Not read": "not_read"}
    rows = []
    for link, name, one in _sets(summary):
        alone, hits = one["bounds"]["clutter_free"], one["hit_rate"]
        if hits is None or alone is None:
            continue
        losses = (one["losses"][cause] for cause in causes.values())
        false = sum(one["false_tracks"][kind] or 0.0 for kind in _CITY)
        cost = number(round(alone - hits, 3))
        figures = (number(one["counts"]["hit_rate"][1]), number(hits), number(alone), cost)
        rows.append(
            (
                link_words(link),
                name,
                *figures,
                *map(number, losses),
                number(false),
                number(one["ser_delay"]),
            )
        )
    titles = ("In view", "Hit rate", "In noise alone", "The city costs", *causes)
    ends = ("False tracks of the city", "SER delay")
    return Table(("Link", "Receivers", *titles, *ends), rows)


def link_words(name: str) -> str:
    """AT to PT1, of AT->PT1."""
    return name.replace("->", " to ")


def rmse_table(summary: Mapping[str, Any]) -> Table:
    """RMSE of detections and of tracks."""
    columns = ("RMSE", *_AXES)
    rows = [
        (f"{link_words(name)}, {word}", *(number(v) for v in s[key].values()))
        for name, s in summary["links"].items()
        for key, word in (("rmse", "detections"), ("rmse_tracked", "tracks"))
    ]
    return Table(columns, rows)


_SEES = {
    "Range to [m]": "max_range_m",
    "Range cell [m]": "range_resolution_m",
    "Velocity to [m/s]": "max_velocity_mps",
    "Velocity cell [m/s]": "velocity_resolution_mps",
    "Azimuth beam [deg]": "azimuth_resolution_deg",
    "Elevation beam [deg]": "elevation_resolution_deg",
    "View to [deg]": "field_of_view_deg",
    "Bit rate [kbit/s]": "bit_rate_bps",
}
_OUTSIDE = ("out_of_view", "beyond_range", "too_near", "too_fast")


def coverage_tables(seen: Mapping[str, Any]) -> tuple[Table, str, Table]:
    """Tabulate the coverage of the radar: one row for each set of links that see alike, the times
    and what the columns mean in words, and the frames in which UAVs are outside.

    Parameters
    ----------
    seen : `isac_rt.simulation.coverage.Coverage` as a mapping
    """
    alike: dict[tuple[str, ...], list[str]] = {}
    for of in seen["links"]:
        row = {
            **of,
            "bit_rate_bps": None if of["bit_rate_bps"] is None else of["bit_rate_bps"] / 1e3,
        }
        alike.setdefault(tuple(number(row[key]) for key in _SEES.values()), []).append(
            link_words(of["link"])
        )
    limits = Table(("Sees", *_SEES), [(", ".join(names), *row) for row, names in alike.items()])
    farthest = max(seen["links"], key=lambda of: of["max_range_m"])
    slot, frame, interval = (
        number(seen[key] * unit)
        for key, unit in (("slot_s", 1e6), ("frame_s", 1e3), ("frame_interval_s", 1e3))
    )
    past = ""
    if farthest["filtered_range_m"] > farthest["max_range_m"]:
        past = (
            ", and hold with data as without; paths of up to twice that range still disturb some "
            "chirps"
        )
    words = (
        f"A slot, one chirp of each group, lasts {slot} us, a frame {frame} ms; a frame begins "
        f"every {interval} ms. Ranges are one way for echoes, the whole way from transmitter to "
        f"receiver otherwise{past}. Faster UAVs are seen at a wrong velocity. A beam is the width "
        "of the array's main lobe ahead; the view reaches so far to each side, and directions are "
        f"unambiguous to {number(farthest['unambiguous_angle_deg'])} deg. Walls in between are "
        "not counted here."
    )
    rows = [
        (
            f"{row['uav']} on {link_words(row['link'])}",
            *(f"{row[key]}" for key in _OUTSIDE),
            f"{row['frames']}",
        )
        for row in seen["outside"]
    ]
    titles = ("Frames outside", "Out of view", "Beyond range", "Too near", "Too fast", "Of frames")
    return limits, words, Table(titles, rows)


def gospa_table(summary: Mapping[str, Any]) -> Table:
    """GOSPA of each link's confirmed tracks with its parts."""
    keys = {
        "GOSPA [m]": "total_m",
        "Empty picture [m]": "empty_m",
        "Localisation [m]": "localisation_m",
        "Missed": "missed",
        "False": "false",
    }
    rows = [
        (link_words(name), *(number(s["gospa"][key]) for key in keys.values()))
        for name, s in summary["links"].items()
        if "gospa" in s
    ]
    return Table(("Picture", *keys), rows)


def apart_table(summary: Mapping[str, Any]) -> Table:
    """Targets and terminals apart, with what could be found of them at most."""
    rows = [
        (
            f"{link_words(name)}, {who}",
            number(part["in_view"]),
            number(part["hit_rate"]),
            *(number(part["bounds"][key]) for key in ("clutter_free", "genie")),
            *(
                number(part["gospa"][key]) if "gospa" in part else DASH
                for key in ("total_m", "empty_m")
            ),
        )
        for name, s in summary["links"].items()
        for who, part in s.get("apart", {}).items()
        if part["in_view"]
    ]
    titles = (
        "Apart",
        "In view",
        "Hit rate",
        "Without clutter",
        "Matched filter",
        "GOSPA [m]",
        "Empty picture [m]",
    )
    return Table(titles, rows)


def swarm_table(summary: Mapping[str, Any]) -> Table:
    """The pictures of terminals that cooperate, all of them together first; no rows where none
    does."""
    swarm = summary.get("swarm")
    if swarm is None:
        return Table((), ())
    rows = [
        (
            name,
            number(p["hit_rate"]),
            *(number(p["gospa"][key]) for key in ("total_m", "empty_m", "missed", "false")),
            *(number(p["rmse"][key]) for key in ("position_m", "velocity_mps")),
            number(p["nees"]),
            *(number(p[key]) for key in ("reports_per_frame", "age_s")),
            *_traffic(p, name in swarm["terminals"]),
        )
        for name, p in {"All together": swarm, **swarm["terminals"]}.items()
    ]
    titles = (
        "Picture",
        "Hit rate",
        "GOSPA [m]",
        "Empty picture [m]",
        "Missed",
        "False",
        "Position [m]",
        "Velocity [m/s]",
        "NEES",
        "Heard",
        "Age [s]",
        "Left out",
        "kbit of room",
        "Lost messages",
    )
    return Table(titles, rows)


def _traffic(picture: Mapping[str, Any], told: bool) -> tuple[str, str, str]:
    """Tabulate what the messages to a terminal left out, their bits, and those of them that were
    lost."""
    if not told:
        return DASH, DASH, DASH
    bits = f"{number(picture['bits'] / 1e3)} of {number(picture['bits_room'] / 1e3)}"
    lost = f"{picture['messages_lost']} of {picture['messages']}"
    return number(picture["left_out"]), bits, lost


def false_table(summary: Mapping[str, Any]) -> Table:
    """False tracks per frame of each link by what feeds them; causes that never were are left
    out."""
    links = {name: s for name, s in summary["links"].items() if "false_tracks" in s}
    causes = [c for c in FALSE_CAUSES if any(s["false_tracks"][c] for s in links.values())]
    rows = [
        (
            link_words(name),
            *map(number, (s["false_tracks_per_frame"], *map(s["false_tracks"].get, causes))),
        )
        for name, s in links.items()
    ]
    titles = (cause.replace("_", " ").capitalize() for cause in causes)
    return Table(("False tracks per frame", "All", *titles), rows)


def _targets(summary: Mapping[str, Any]) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """(link, UAV, figures) of what was in view at some time."""
    for link, s in summary["links"].items():
        for uav, t in s.get("targets", {}).items():
            if t["in_view"]:
                yield link_words(link), uav, t


def target_table(summary: Mapping[str, Any]) -> Table:
    """Who saw whom, and how often."""
    keys = ("in_view", "found", "tracked", "switches")
    rows = [(link, uav, *(number(t[key]) for key in keys)) for link, uav, t in _targets(summary)]
    return Table(("Link", "UAV", "In view", "Found", "Tracked", "Switches"), rows)


def error_table(summary: Mapping[str, Any]) -> Table:
    """Median and 90 % of the errors of each UAV, and beside them what no unbiased estimator goes
    below; UAVs that were never found are left out."""
    columns = ("Link", "UAV", "", *_AXES)
    rows = []
    for link, uav, t in _targets(summary):
        if any(middle is not None for middle in t["median"].values()):
            rows.append((link, uav, "error", *_pairs(t["median"], t["p90"])))
            if "bound_median" in t:
                rows.append((link, uav, "bound", *_pairs(t["bound_median"], t["bound_p90"])))
    return Table(columns, rows)


_AXES = ("Range [m]", "Velocity [m/s]", "Azimuth [deg]", "Elevation [deg]")


def _pairs(middle: Mapping[str, float | None], most: Mapping[str, float | None]) -> list[str]:
    """Median / 90 % on each axis."""
    return [
        DASH if value is None else f"{number(value, 2)} / {number(most[key], 2)}"
        for key, value in middle.items()
    ]


def loss_table(summary: Mapping[str, Any]) -> Table:
    """Tabulate the outcome of every target-frame in view; causes without frames are left out."""
    rows = list(_targets(summary))
    causes = [c for c in LOSSES if any(t["losses"][c] for _, _, t in rows)]
    titles = (cause.replace("_", " ").capitalize() for cause in causes)
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
