"""Findings of checks and estimates, for the terminal, JSON, tracks and reports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Annotated, Literal

from pydantic import AfterValidator

from jawusd.base.errors import shown

#: An error makes the result impossible or useless; a warning may make it wrong; a note explains what was done.
Severity = Literal["error", "warning", "note"]


@dataclass(frozen=True)
class Finding:
    """Problem or remark: place, measured value, limit, and what to do."""

    kind: str  # stable identifier for programs, such as "scans_apart"
    severity: Severity
    message: str  # one sentence without the place: what was found and what is allowed, with units
    value: float | None = None  # Measured value, in the unit stated in the message.
    limit: float | None = None  # Limit of the value, in the same unit.
    path: str | None = None
    camera: str | None = None
    frame: int | None = None
    hint: str | None = None  # what the user can do about the problem

    def line(self) -> str:
        """Return the finding as one line of text."""
        frame = None if self.frame is None else f"frame {self.frame}"
        camera = None if self.camera is None else f"camera {self.camera}"
        where = ", ".join(part for part in (self.path, camera, frame) if part)
        text = f"{self.severity}: {where}: {self.message}" if where else f"{self.severity}: {self.message}"
        end = "" if text.endswith((".", "!", "?")) else "."
        return shown(f"{text}{end} {self.hint}" if self.hint else text)

    def as_json(self) -> dict[str, str | float | int]:
        """Return the fields that are set, for JSON."""
        return {key: value for key, value in asdict(self).items() if value is not None}

    @classmethod
    def from_json(cls, found: Mapping[str, str | float | int]) -> Finding:
        """Return the finding from the output of `as_json`; unknown fields are ignored, missing fields get defaults."""
        severities: dict[object, Severity] = {"error": "error", "note": "note"}
        texts = {name: str(found[name]) for name in ("path", "camera", "hint") if name in found}
        numbers = {name: float(found[name]) for name in ("value", "limit") if name in found}
        return cls(
            kind=str(found.get("kind", "")),
            severity=severities.get(found.get("severity"), "warning"),
            message=str(found.get("message", "")),
            value=numbers.get("value"),
            limit=numbers.get("limit"),
            path=texts.get("path"),
            camera=texts.get("camera"),
            frame=int(found["frame"]) if "frame" in found else None,
            hint=texts.get("hint"),
        )


def _readable(found: dict[str, str | float | int]) -> dict[str, str | float | int]:
    try:
        Finding.from_json(found)
    except OverflowError as error:
        raise ValueError(str(error)) from error
    return found


#: Output of `Finding.as_json`, validated by pydantic.
FoundJson = Annotated[dict[str, str | float | int], AfterValidator(_readable)]
