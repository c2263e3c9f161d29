# SPDX-License-Identifier: MIT
"""What `densify doctor` and `densify bench doctor` print."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from typing import Any

from densify.doctor import Diagnosis, Verdict
from densify.outputs.plain import plain

_WIDTH = 100


def diagnosis_table(diagnosis: Diagnosis) -> str:
    """A verdict, a check and its evidence to a line, remedies below them, and the sum."""
    columns = 2 + max(len(str(v)) for v in Verdict)
    lines = []
    for finding in diagnosis.findings:
        text = f"{finding.check}: {finding.evidence}"
        lines += textwrap.wrap(
            text,
            _WIDTH,
            initial_indent=f"{finding.verdict!s:<{columns}}",
            subsequent_indent=" " * columns,
        )
        if finding.remedy:
            lines.append(" " * columns + f"-> {finding.remedy}")
    counts = {v: sum(f.verdict == v for f in diagnosis.findings) for v in Verdict}
    return "\n".join([*lines, "", ", ".join(f"{n} {v}" for v, n in counts.items())])


def diagnosis_facts(diagnosis: Diagnosis) -> dict[str, Any]:
    """The findings with their values, for programs."""
    return {
        "recording": diagnosis.sample.sequence.name,
        "worst": str(diagnosis.worst),
        "findings": [
            {
                "check": f.check,
                "verdict": str(f.verdict),
                "evidence": f.evidence,
                "remedy": f.remedy,
                "values": plain(f.values),
            }
            for f in diagnosis.findings
        ],
    }


def fault_table(spec: str, measured: Mapping[str, Any]) -> str:
    """What `densify.bench.faults.bench_doctor` returns."""
    faults = measured["faults"]
    num_found = sum(fault["found"] for fault in faults.values())
    alarms = measured["false_alarms"]
    lines = [
        f"{spec}: {num_found} of {len(faults)} faults named; false alarms on the recording as it "
        f"is: {', '.join(alarms) or 'none'}"
    ]
    width = max(len(name) for name in faults)
    for name, fault in faults.items():
        lines.append(f"  {name:<{width}}  {fault['verdict'] if fault['found'] else 'MISSED'}")
    return "\n".join(lines)
