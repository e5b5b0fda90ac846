"""Verdicts of gates: what was found, what is let through, and what could not be tested.

A gate is one criterion or several of one matter. Each holds its own bound and in which sense it is
one, so that whoever reads the figures can judge them again.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from calibration.errors import CalibrationRefusedError


class Sense(StrEnum):
    """What a bound bounds."""

    AT_MOST = "at most"
    AT_LEAST = "at least"


@dataclass(frozen=True)
class Criterion:
    """A figure and what is let through.

    Attributes
    ----------
    name : str
        What the figure is.
    value, bound : float
    sense : Sense
    refuses : bool
        Whether failing refuses the calibration; otherwise it is flagged.
    """

    name: str
    value: float
    bound: float
    sense: Sense = Sense.AT_MOST
    refuses: bool = True

    @property
    def passed(self) -> bool:
        """Whether it holds; a figure that is not known does not."""
        if self.sense is Sense.AT_MOST:
            return bool(self.value <= self.bound)
        return bool(self.value >= self.bound)


@dataclass(frozen=True)
class Verdict:
    """Outcome of one gate.

    Attributes
    ----------
    gate : str
    criteria : tuple of Criterion
        One at least; the gate is passed if all hold.
    what_to_do : str
        What is wrong if it is, and what to do then.
    subject : str
        The lens, where each has a gate of its own.
    """

    gate: str
    criteria: tuple[Criterion, ...]
    what_to_do: str
    subject: str = ""

    @property
    def passed(self) -> bool:
        """Whether all criteria hold."""
        return all(criterion.passed for criterion in self.criteria)

    @property
    def refuses(self) -> bool:
        """Whether it fails by a criterion that refuses the calibration."""
        return any(c.refuses and not c.passed for c in self.criteria)

    @property
    def remedy(self) -> str:
        """What is wrong and what to do; empty if the gate is passed."""
        return "" if self.passed else self.what_to_do

    @property
    def outcome(self) -> str:
        """In a word."""
        if self.passed:
            return "holds"
        return "refused" if self.refuses else "warning"

    def figures(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "gate": str(self.gate),
            "subject": self.subject,
            "criteria": [
                {
                    "name": c.name,
                    "value": c.value,
                    "sense": str(c.sense),
                    "bound": c.bound,
                    "passed": c.passed,
                    "refuses": c.refuses,
                }
                for c in self.criteria
            ],
            "passed": self.passed,
            "outcome": self.outcome,
            "remedy": self.remedy,
        }


@dataclass(frozen=True)
class Untested:
    """A gate that could not be tested.

    Attributes
    ----------
    gate : str
    why : str
        What is missing.
    """

    gate: str
    why: str

    def __str__(self) -> str:
        return f"{self.gate} ({self.why})"


@dataclass(frozen=True)
class GateReport:
    """Outcomes of all gates, and those that could not be tested.

    Attributes
    ----------
    verdicts : tuple of Verdict
    not_tested : tuple of Untested
    """

    verdicts: tuple[Verdict, ...]
    not_tested: tuple[Untested, ...] = ()

    @property
    def passed(self) -> bool:
        """Whether no gate that was tested refuses the calibration."""
        return not any(verdict.refuses for verdict in self.verdicts)

    @property
    def failures(self) -> tuple[Verdict, ...]:
        """Gates that failed, whether they refuse or flag."""
        return tuple(v for v in self.verdicts if not v.passed)

    def refuse(self) -> None:
        """Refuse a calibration that failed.

        Raises
        ------
        CalibrationRefusedError
            With every failure and what to do about it.
        """
        if not self.passed:
            reasons = "; ".join(f"{v.gate}: {v.remedy}" for v in self.verdicts if v.refuses)
            raise CalibrationRefusedError(f"the calibration is refused. {reasons}")

    def figures(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "passed": self.passed,
            "gates": [verdict.figures() for verdict in self.verdicts],
            "not_tested": [{"gate": str(u.gate), "why": u.why} for u in self.not_tested],
        }

    def sentence(self) -> str:
        """The verdict in words."""
        if not self.passed:
            said = "Refused: nothing should be measured with it. The gates say what to record."
        elif self.failures:
            count = len(self.failures)
            said = f"Passed, with {count} warning{'s' if count > 1 else ''}: see the gates."
        elif self.not_tested:
            said = f"Passed: all {len(self.verdicts)} gates that could be tested hold."
        else:
            said = "Passed: every gate holds."
        if self.not_tested:
            said += f" Not tested: {'; '.join(map(str, self.not_tested))}."
        return said
