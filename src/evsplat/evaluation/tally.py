"""Means over frames, with the reason wherever there is none."""

from typing import Any

from evsplat.evaluation.protocols import METRICS, REGIONS, Absent, Measured, Value


class Tally:
    """Collects what was measured in one frame after the other."""

    def __init__(self, regions: tuple[str, ...] = REGIONS) -> None:
        self._values: dict[tuple[str, str], list[Value]] = {
            (region, metric): [] for region in regions for metric in METRICS
        }

    def add(self, measured: Measured) -> None:
        """One frame's figures; regions that this tally does not keep are ignored."""
        for (region, metric), values in self._values.items():
            values.append(measured[region][metric])

    def means(self) -> tuple[dict[str, dict[str, float | None]], dict[str, str]]:
        """Mean per region and metric over the frames that have it, and "region.metric" -> reason.

        A figure that some frames lack keeps a reason that says how many.
        """
        means: dict[str, dict[str, float | None]] = {}
        reasons: dict[str, str] = {}
        for (region, metric), values in self._values.items():
            numbers = [value for value in values if not isinstance(value, Absent)]
            gaps = [value.reason for value in values if isinstance(value, Absent)]
            means.setdefault(region, {})[metric] = sum(numbers) / len(numbers) if numbers else None
            if gaps and numbers:
                reasons[f"{region}.{metric}"] = (
                    f"missing in {len(gaps)} of {len(values)}: {gaps[0]}"
                )
            elif not numbers:
                reasons[f"{region}.{metric}"] = gaps[0] if gaps else "no picture to measure"
        return means, reasons


def without_reasons(measured: Measured) -> dict[str, Any]:
    """The figures of one frame for JSON: None where one was not measured."""
    return {
        region: {
            metric: None if isinstance(value, Absent) else value for metric, value in values.items()
        }
        for region, values in measured.items()
    }


def all_absent(reason: str) -> Measured:
    """Every figure missing for one reason."""
    return {region: dict.fromkeys(METRICS, Absent(reason)) for region in REGIONS}
