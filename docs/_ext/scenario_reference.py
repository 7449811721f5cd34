"""Fills the page `scenario.md`, the reference of every scenario key, from the schema."""

from __future__ import annotations

import json
from typing import Any

HEAD = """# Scenario reference

Every key of a scenario, from the schema that `isac-rt schema` prints. A key's name ends in its
unit; a key without a default must be given.
"""


def kind_of(entry: dict[str, Any], definitions: dict[str, Any]) -> str:
    """What a value may be, in words."""
    if "$ref" in entry:
        name = entry["$ref"].rsplit("/", 1)[-1]
        return f"[{name}](#{name.lower()})"
    if "anyOf" in entry:
        return " or ".join(dict.fromkeys(kind_of(e, definitions) for e in entry["anyOf"]))
    if "oneOf" in entry:
        return " or ".join(dict.fromkeys(kind_of(e, definitions) for e in entry["oneOf"]))
    if "enum" in entry:
        return ", ".join(f"`{json.dumps(v).strip(chr(34))}`" for v in entry["enum"])
    if "const" in entry:
        return f"`{entry['const']}`"
    if entry.get("type") == "array":
        inner = entry.get("items")
        return "list" + (f" of {kind_of(inner, definitions)}" if isinstance(inner, dict) else "")
    if entry.get("type") == "object":
        inner = entry.get("additionalProperties")
        if "patternProperties" in entry:  # names of UAVs
            (inner,) = entry["patternProperties"].values()
        return "mapping" + (f" to {kind_of(inner, definitions)}" if isinstance(inner, dict) else "")
    signs = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}
    limits = [f"{sign} {entry[key]:g}" for key, sign in signs.items() if key in entry]
    return " ".join([str(entry.get("type", "anything")), ", ".join(limits)]).strip()


def default_of(entry: dict[str, Any]) -> str:
    if "default" not in entry:
        return ""
    text = json.dumps(entry["default"])
    return "as below" if isinstance(entry["default"], dict) and entry["default"] else f"`{text}`"


def table(node: dict[str, Any], definitions: dict[str, Any]) -> list[str]:
    required = set(node.get("required", ()))
    lines = ["| key | value | default | meaning |", "|---|---|---|---|"]
    for name, entry in node.get("properties", {}).items():
        meaning = " ".join(str(entry.get("description", "")).split()).replace("|", "\\|")
        default = "required" if name in required else default_of(entry)
        lines.append(f"| `{name}` | {kind_of(entry, definitions)} | {default} | {meaning} |")
    return lines


def reference(schema: dict[str, Any]) -> str:
    """The page's Markdown."""
    definitions = schema.get("$defs", {})
    parts = [HEAD, "## The file", "", *table(schema, definitions)]
    for name, node in definitions.items():
        if "properties" in node:
            about = node.get("description", "")
            parts += ["", f"## {name}", "", about, "", *table(node, definitions)]
    return "\n".join(parts) + "\n"


def fill(app: Any, name: str, source: list[str]) -> None:
    """Put the reference in place of the text of `scenario.md`."""
    if name == "scenario":
        from isac_rt.scenario.tree import json_schema

        source[0] = reference(json_schema())


def outdated(app: Any, env: Any, added: set, changed: set, removed: set) -> list[str]:
    """Return the page, which is written anew by every build: the schema may have changed."""
    return ["scenario"]


def setup(app: Any) -> dict[str, bool]:
    app.connect("source-read", fill)
    app.connect("env-get-outdated", outdated)
    return {"parallel_read_safe": True}
