"""What every fitting method returns: a decoder and which frames it was fitted to."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jawusd.evaluator.models import AnchoredModel, JawModelForm
from jawusd.geometry.arrays import Array, Mask


@dataclass(frozen=True, eq=False)
class FittedForm:
    """Hold a fitted decoder."""

    model: JawModelForm
    kept: Mask  # training frames that were not trimmed, shape (N,)
    notes: dict[str, object]  # JSON-able facts about the fit, for the header

    @property
    def kind(self) -> str:
        """Return the kind of model: "anchored" or "additive"."""
        return "anchored" if isinstance(self.model, AnchoredModel) else "additive"

    def arrays(self) -> dict[str, Array]:
        """Return the decoder's own arrays under their names in a rig."""
        if isinstance(self.model, AnchoredModel):
            gauge = self.model.gauge
            return {
                "path_coefficients": gauge.path_coefficients,
                "path_scale_mm": np.array(gauge.path_scale_mm),
                "path_limits": np.array(gauge.path_limits),
                "glide_arch": gauge.glide_arch,
                "glide_drop": gauge.glide_drop,
                "glide_softness_mm": np.array(gauge.glide_softness_mm),
                "glide_fade_mm": np.array(gauge.glide_fade_mm),
                "spline_scales": self.model.scales,
                "spline_centres": self.model.centres,
                "spline_weights": self.model.weights,
            }
        arrays: dict[str, Array] = {}
        for number, curve in enumerate(self.model.curves, start=1):
            parts = (("knots", curve.knots), ("twists", curve.values), ("slopes", curve.slopes))
            arrays |= {f"curve{number}_{name}": values for name, values in parts}
        return arrays
