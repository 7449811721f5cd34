"""Card of a data set in the form of Croissant 1.0 [1]_, which repositories and loaders read.

References
----------
.. [1] MLCommons, "Croissant format specification", version 1.0, mlcommons.org/croissant/1.0.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_OWN_TERMS = """citeAs column equivalentProperty extract field fileProperty fileObject fileSet
format includes isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated
replace samplingRate separator source subField transform"""
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _OWN_TERMS.split()},
}
"""The context that the specification gives."""


def croissant(
    about: Mapping[str, Any], splits: Mapping[str, list[dict[str, Any]]], keep: tuple[str, ...]
) -> dict[str, Any]:
    """Return the card as JSON-LD.

    Parameters
    ----------
    about : name, license and what else schema.org asks of a data set
    splits : of each its shards: file, bytes and SHA-256 of a tar
    keep : parts of every sample
    """
    shards = [shard for names in splits.values() for shard in names]
    sets = [
        _file_set(f"{split}-{part}", f"*.{part}.npy", "application/x-npy", names)
        for split, names in splits.items()
        for part in keep
    ]
    truth = [
        _file_set(f"{split}-truth", "*.json", "application/json", names)
        for split, names in splits.items()
    ]
    return {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        **about,
        "distribution": [*map(_shard, shards), *truth, *sets],
        "recordSet": [_records(split) for split, names in splits.items() if names],
    }


def _shard(shard: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": shard["file"],
        "name": shard["file"],
        "contentUrl": shard["file"],
        "contentSize": f"{shard['bytes']} B",
        "encodingFormat": "application/x-tar",
        "sha256": shard["sha256"],
    }


def _file_set(name: str, includes: str, form: str, shards: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the files of one kind in the shards of a split."""
    return {
        "@type": "cr:FileSet",
        "@id": name,
        "name": name,
        "containedIn": [{"@id": shard["file"]} for shard in shards],
        "encodingFormat": form,
        "includes": includes,
    }


def _records(split: str) -> dict[str, Any]:
    """Return the samples of a split: names and contents of the files of their truth."""

    def field(name: str, meaning: str, of_file: str) -> dict[str, Any]:
        return {
            "@type": "cr:Field",
            "@id": f"{split}/{name}",
            "name": f"{split}/{name}",
            "description": meaning,
            "dataType": "sc:Text",
            "source": {
                "fileSet": {"@id": f"{split}-truth"},
                "extract": {"fileProperty": of_file},
            },
        }

    return {
        "@type": "cr:RecordSet",
        "@id": split,
        "name": split,
        "key": {"@id": f"{split}/key"},
        "field": [
            field(
                "key", "file of the truth; what other files of the sample begin with", "filename"
            ),
            field("truth", "JSON: time, ends of the link, and every UAV", "content"),
        ],
    }
