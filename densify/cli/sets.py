# SPDX-License-Identifier: MIT
"""What `densify dataset` says of a set."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from densify.dataset.make import Summary

FIRST_OF_SET = {
    "README.txt": "what the set holds and how to read it",
    "manifest.jsonl": "every key with its files and scores",
    "dataset.json": "how it was made",
}
_MOST_SHOWN = 20


def set_summary(summary: Summary) -> str:
    """What was made, and what is missing and why."""
    counts = [
        f"{summary.count(status)} {said}"
        for status, said in (("done", "done"), ("aside", "put aside"), ("failed", "failed"))
        if summary.count(status) or status == "done"
    ]
    if summary.num_left:
        counts.append(f"{summary.num_left} to make")
    lines = [f"{summary.num_keys} keys: {', '.join(counts)}"]
    if summary.num_made:
        pace = summary.seconds / summary.num_made
        lines[0] += f"; {summary.num_made} now, {pace:.2f} s a key"
    lines.append(set_scores(summary))
    missing = [r for r in summary.records.values() if r.status != "done"]
    lines += [f"{r.drive} {r.key} {r.status}: {r.reason}" for r in missing[:_MOST_SHOWN]]
    if len(missing) > _MOST_SHOWN:
        lines.append(f"... and {len(missing) - _MOST_SHOWN} more, see the manifest")
    return "\n".join(line for line in lines if line)


def set_facts(summary: Summary) -> dict[str, Any]:
    """The same for programs."""
    missing = [r for r in summary.records.values() if r.status != "done"]
    return {
        "num_keys": summary.num_keys,
        **{f"num_{status}": summary.count(status) for status in ("done", "aside", "failed")},
        "num_left": summary.num_left,
        "num_made": summary.num_made,
        "seconds": summary.seconds,
        "means": {score: summary.mean(score) for score in ("density", "ghost", "outliers")},
        "missing": [
            {"drive": r.drive, "key": r.key, "status": r.status, "reason": r.reason}
            for r in missing
        ],
    }


def set_scores(summary: Summary) -> str:
    """Means over the keys so far; empty before the first."""
    told = (
        ("density", "density"),
        ("ghost", "ghosts"),
        ("outliers", "held-out outliers"),
    )
    means = [(said, summary.mean(score)) for score, said in told]
    return ", ".join(f"{said} {100 * mean:.2f} %" for said, mean in means if mean is not None)
