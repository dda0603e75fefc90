"""How a fit ended, and what the user may do about it."""

from __future__ import annotations

from dataclasses import dataclass

from shapespace.model.fit_result import FitStatus
from shapespace.model.fit_settings import SETTINGS
from shapespace.model.fit_uncertainty import Doubt


def is_poor(explained: float, seen: float, *, partial: bool) -> bool:
    """Say whether a fit is poor, from the shares of the scan and of the model that lie at the other side."""
    if partial:
        return 1 - explained > SETTINGS.missed_of_part
    return 1 - explained > SETTINGS.missed and 1 - seen > SETTINGS.unseen


@dataclass(frozen=True)
class FitVerdict:
    """What is known about the quality of a finished fit."""

    explained: float  # share of the scan that lies at the shape
    seen: float  # share of the shape's area that lies at the scan
    moved: float  # largest movement of the shape in the last step, as a fraction of the diagonal
    mirrored: float | None  # cost of the scan's mirror image as a share of the scan's own cost, if the fit is poor
    apart: float | None  # distance of another fit that is nearly as good, as a fraction of the diagonal
    doubt: Doubt | None  # what the scan leaves open
    partial: bool  # whether the options say that the scan shows a part
    free: bool  # whether the options leave the size open

    def status(self, *, late: bool) -> tuple[FitStatus, str]:
        """Return the status and the reason in words; ``late`` says that the time ended first."""
        shares = (
            f"{self.explained:.0%} of the scan is near the model, and {self.seen:.0%} of the model is near the scan"
        )
        if late:
            return FitStatus.DEADLINE, (
                f"The time ended before the fit converged: {shares} so far. Give fewer points or a coarser scan."
            )
        if is_poor(self.explained, self.seen, partial=self.partial):
            reason = f"Only {shares}: the scan is not a shape of this model, or the search failed."
            return FitStatus.POOR, f"{reason} {self._advice}"
        if self.apart is not None:
            return FitStatus.AMBIGUOUS, (
                f"{shares}, but another fit, {self.apart:.0%} of the diagonal away on average, is nearly as good."
            )
        if self.doubt is not None:
            return FitStatus.AMBIGUOUS, f"{shares}, but {self.doubt.words}"
        if self.moved > SETTINGS.restless:
            return FitStatus.STALLED, (
                f"{shares}, but the last step still moved the model by {self.moved:.1%} of the diagonal."
            )
        return FitStatus.CONVERGED, f"{shares}."

    @property
    def _advice(self) -> str:
        """What may help a poor fit."""
        if self.mirrored is not None and self.mirrored < SETTINGS.mirrored:
            return "Its mirror image fits much better: change the sign of one coordinate."
        part = "" if self.partial else "If it shows a part only, set the option `partial`. "
        size = "" if self.free else "If its size may differ from the model's, set scale=free. "
        return f"{part}{size}Three landmarks also help."
