"""How much work a decomposition may be: named points on the curve between speed and quality."""

from __future__ import annotations

from dataclasses import dataclass

from unshade.growth import Effort


@dataclass(frozen=True)
class Preset:
    """A point on the curve between speed and quality. Work is counted in steps, so a result never depends on the machine."""

    name: str
    effort: Effort
    fine: int
    """Points on which the result is polished."""
    members: int
    """Most trees in the family."""
    summary: str

    @property
    def max_values(self) -> int:
        """Most values a tree may store."""
        return self.effort.max_values


PRESETS = {
    preset.name: preset
    for preset in (
        Preset("draft", Effort(30, beam=0, trials=3, rounds=0, sweeps=0, polish_steps=10), 4000, 6, "at once, 30 values"),
        Preset("balanced", Effort(64), 8000, 10, "a second or two, 64 values"),
        Preset(
            "best",
            Effort(160, beam=2, beam_moves=5, trials=5, rounds=4, polish_steps=30, late=True),
            12000,
            16,
            "several seconds, 160 values",
        ),
    )
}
