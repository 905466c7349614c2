"""A jaw rig as a torch module: poses, margins, clearances, encoding, and priors to add to other solvers."""

from __future__ import annotations

from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from jawusd.base.errors import EvaluatorError
from jawusd.evaluator import JawRig
from jawusd.evaluator.contact import ContactField, Meeting
from jawusd.evaluator.encoding import landmark_vectors
from jawusd.evaluator.speeds import Speeds
from jawusd.geometry.se3 import se3_inverse
from jawusd.solvers.charts import chart_of
from jawusd.solvers.encoding import encoded
from jawusd.solvers.hull import Hull
from jawusd.solvers.interior import Interior
from jawusd.solvers.solution import attached, check_precision, full_precision, solved

_CORNERS = [(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)]


class Clearances(nn.Module):
    """A clearance field over d; all its data are torch buffers."""

    first: Tensor
    step: Tensor
    last: Tensor
    values: Tensor

    def __init__(self, field: ContactField) -> None:
        super().__init__()
        last = np.array(field.values.shape, dtype=np.float64) - 1.0
        for name, value in (("first", field.first_mm), ("step", field.step_mm), ("last", last)):
            self.register_buffer(name, torch.tensor(value))
        self.register_buffer("values", torch.tensor(field.values.ravel()))

    def forward(self, d: Tensor) -> Tensor:
        """Return the clearances (n,) [mm] at d (n, 3) [mm]; NaN for NaN."""
        place = torch.minimum(torch.clamp((d - self.first) / self.step, min=0.0), self.last)
        cell = torch.minimum(torch.nan_to_num(place.detach()).floor(), self.last - 1.0)
        share = place - cell
        counts, low = self.last.long() + 1, cell.long()
        found = torch.zeros_like(d[:, 0])
        for i, j, k in _CORNERS:
            row = ((low[:, 0] + i) * counts[1] + low[:, 1] + j) * counts[2] + low[:, 2] + k
            a, b, c = (share[:, axis] if far else 1.0 - share[:, axis] for axis, far in enumerate((i, j, k)))
            found = found + self.values[row] * a * b * c
        return found


class TemporalPrior(nn.Module):
    """A prior on motion: squared Mahalanobis norms of velocity and acceleration of d, zero for a jaw at rest.

    Both are modelled as normally distributed with mean zero; the inverses of their covariances are buffers, float64.
    `JawRig.speeds` or `Speeds.of_take` give the statistics.
    """

    velocity: Tensor
    acceleration: Tensor

    def __init__(self, speeds: Speeds) -> None:
        super().__init__()
        for name, covariance in (("velocity", speeds.velocity), ("acceleration", speeds.acceleration)):
            self.register_buffer(name, torch.linalg.inv(torch.tensor(covariance)))

    @full_precision
    def forward(self, d: Tensor, fps: float) -> Tensor:
        """Return the prior (...) of d (..., F, 3) [mm] at a frame rate [1/s]; about 3 for motion as in the take.

        It is half the sum of the mean squared Mahalanobis norms of velocities and accelerations.

        Raises:
            ValueError: fewer than three frames.
            TypeError: a dtype other than the prior's, or coarser than float32.
        """
        if d.ndim < 2 or d.shape[-1] != 3 or d.shape[-2] < 3:
            raise ValueError(f"the shape of d must end in (F, 3) with three frames or more, got {tuple(d.shape)}")
        check_precision("d", d.dtype, self.velocity.dtype)
        velocity = (d[..., 1:, :] - d[..., :-1, :]) * fps
        acceleration = (velocity[..., 1:, :] - velocity[..., :-1, :]) * fps
        lengths = [
            ((change @ precision) * change).sum(dim=-1).mean(dim=-1)
            for change, precision in ((velocity, self.velocity), (acceleration, self.acceleration))
        ]
        return 0.5 * (lengths[0] + lengths[1])


class JawLayer(nn.Module):
    """Evaluate a rig on torch tensors, with gradients, in float32 or float64, on any device.

    ``layer(d)`` is `JawRig.pose`. There are no trainable parameters. All data are buffers: ``.to(...)`` moves them,
    `state_dict` saves them, and `load_state_dict` accepts only the state of the same rig. Every function works under
    `torch.func`, `torch.compile(fullgraph=True)`, `torch.export` and its ONNX exporter, for any batch shape.

    `encode` and `loss` have first and second derivatives; `residuals`, `project` and `inside` have only first
    derivatives. `temporal` is None if the rig has no speeds.

    All functions compute in the precision of the layer: autocast and TensorFloat-32 are off within them. A captured
    graph, however, uses the matrix multiplication precision that the surrounding program has set.

    Raises:
        EvaluatorError: the bound of the rig is empty or not connected.
    """

    to_anatomical: Tensor
    from_anatomical: Tensor
    closed: Tensor
    vectors: Tensor
    vectors_at_rest: Tensor
    incisor: Tensor
    rig_hash: Tensor

    def __init__(self, rig: JawRig) -> None:
        super().__init__()
        self.motion = chart_of(rig.kind, rig.arrays)
        self.bound = Hull(rig.arrays)
        self.interior = Interior(rig.arrays)
        self.teeth = None if rig.contact is None else Clearances(rig.contact)
        self.condyles = None if rig.joints is None else Clearances(rig.joints)
        self.temporal = None if rig.speeds is None else TemporalPrior(rig.speeds)
        A = rig.T_anatomical_skull
        closed = A @ rig.T_rest
        vectors = landmark_vectors(rig.landmarks)
        in_mandible = se3_inverse(closed) @ [*rig.incisor, 1.0]
        buffers = {
            "to_anatomical": A,
            "from_anatomical": se3_inverse(A),
            "closed": closed,
            "vectors": vectors,
            "vectors_at_rest": closed @ vectors,
            "incisor": in_mandible,
        }
        for name, value in buffers.items():
            self.register_buffer(name, torch.tensor(value))
        self.register_buffer("rig_hash", torch.tensor(list(bytes.fromhex(rig.model_hash)), dtype=torch.uint8))
        self.register_load_state_dict_pre_hook(_reject_other_rigs)

    @full_precision
    def forward(self, d: Tensor) -> Tensor:
        """Return the poses T_skull_mandible, shape (..., 4, 4), for jaw parameters d (..., 3) [mm]."""
        rows = self._rows(d, (3,), "d")
        return (self.from_anatomical @ self.motion(rows) @ self.closed).reshape(*d.shape[:-1], 4, 4)

    @full_precision
    def margin(self, d: Tensor) -> Tensor:
        """Return the signed distance (...) of d (..., 3) to the bound [mm], positive inside."""
        return self.bound.margin(self._rows(d, (3,), "d")).reshape(d.shape[:-1])

    def penalty(self, d: Tensor) -> Tensor:
        """Return the squared distance (...) by which d (..., 3) lies outside the bound [mm^2]; zero inside."""
        return torch.relu(-self.margin(d)).square()

    @full_precision
    def clearance(self, d: Tensor, of: Meeting = "teeth") -> Tensor:
        """Return the clearance (...) [mm] of teeth or condyles at d (..., 3) [mm], as `JawRig.clearance` does.

        The clearance is negative where the surfaces penetrate deeper than in the closed bite. It is trilinear between
        samples, so its derivative is discontinuous.

        Raises:
            EvaluatorError: the rig has no such clearance.
        """
        field = {"teeth": self.teeth, "condyles": self.condyles}[of]
        if field is None:
            raise EvaluatorError(f"the rig of this JawLayer has no clearance data for the {of}.")
        return cast("Tensor", field(self._rows(d, (3,), "d"))).reshape(d.shape[:-1])

    @full_precision
    def project(self, d: Tensor) -> Tensor:
        """Return the d (..., 3) [mm] with margin >= 0 nearest to given d (..., 3) [mm], as `JawRig.project` does.

        The derivative is the identity inside the bound; outside, it is that of the nearest point on the bound.
        """
        rows = self._rows(d, (3,), "d")
        x, by_d = solved(self.bound.nearest, rows)
        return attached(x, by_d, rows).reshape(d.shape)

    @full_precision
    def inside(self, z: Tensor) -> Tensor:
        """Return valid jaw parameters (..., 3) [mm] for any vectors z (..., 3): a smooth bijection.

        z = 0 maps to the middle of the valid openings, and the bound is approached at infinity. See `Interior`.
        """
        rows = self._rows(z, (3,), "z")
        d, by_z = solved(lambda z: self.interior.mapped(self.bound, z), rows)
        return attached(d, by_z, rows).reshape(z.shape)

    @full_precision
    def unconstrained(self, d: Tensor) -> Tensor:
        """Return the z (..., 3) with ``inside(z) = d`` for jaw parameters d (..., 3) [mm]; NaN outside the bound."""
        return self.interior.unconstrained(self.bound, self._rows(d, (3,), "d")).reshape(d.shape)

    @full_precision
    def encode(self, T_skull_mandible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest d (..., 3) [mm] and residual_mm (...) of poses (..., 4, 4), as `JawRig.encode` does.

        First and second derivatives with respect to the pose are exact, from the implicit function theorem on
        ``grad_d |pose(d) - T|^2 = 0``, including second derivatives of the model. The distance has a kink at zero,
        where its gradient is set to zero.
        """
        d, residuals = self._encode(T_skull_mandible)
        squared = residuals.square().sum(dim=-1)
        on_model = squared == 0
        distance = torch.sqrt(torch.where(on_model, torch.ones_like(squared), squared))
        return d, torch.where(on_model, torch.zeros_like(squared), distance)

    def loss(self, T_skull_mandible: Tensor) -> Tensor:
        """Return a prior on jaw poses (..., 4, 4) [mm^2]: squared residual plus `penalty` of the nearest parameters.

        It is zero for every pose of this subject's jaw and grows with the distance to the model and to the bound. It
        replaces the usual regularisation towards the closed mouth. Shape (...), smooth everywhere.
        """
        return self.residuals(T_skull_mandible).square().sum(dim=-1)

    @full_precision
    def residuals(self, T_skull_mandible: Tensor, sigma_mm: float = 1.0) -> Tensor:
        """Return the prior of `loss` as residuals for least-squares solvers, shape (..., 13).

        Twelve are coordinates of the landmarks' offset from the nearest pose of the model; the last is the distance
        outside the bound; all are divided by ``sigma_mm``. With ``sigma_mm = 1``, the sum of their squares is `loss`,
        and twice ``J^T J`` is its Gauss-Newton Hessian.
        """
        d, residuals = self._encode(T_skull_mandible)
        outside = torch.relu(-self.margin(d))
        return torch.cat([residuals, outside[..., None]], dim=-1) / sigma_mm

    def _encode(self, T_skull_mandible: Tensor) -> tuple[Tensor, Tensor]:
        """Return the nearest d [mm], shape (..., 3), and the residuals (..., 12) [mm]."""
        T = self._rows(T_skull_mandible, (4, 4), "T_skull_mandible")
        moved = (self.to_anatomical @ T @ self.incisor)[:, :3] - (self.closed @ self.incisor)[:3]
        # the four vectors that represent the landmarks, after the motion; see `evaluator.encoding`
        target = (self.to_anatomical @ T @ self.vectors)[:, :3]
        d, residuals = encoded(self.motion, self.vectors_at_rest, target, moved)
        batch = T_skull_mandible.shape[:-2]
        return d.reshape(*batch, 3), residuals.reshape(*batch, 12)

    def _rows(self, values: Tensor, tail: tuple[int, ...], name: str) -> Tensor:
        if values.shape[max(values.ndim - len(tail), 0) :] != tail:
            raise ValueError(f"the shape of {name} must end in {tail}, got {tuple(values.shape)}")
        check_precision(name, values.dtype, self.closed.dtype)
        return values.reshape(-1, *tail)


def _reject_other_rigs(layer: nn.Module, state: dict[str, Tensor], prefix: str, *_: object) -> None:
    """Raise EvaluatorError before loading a state that was saved with another rig, or that does not name its rig."""
    found, own = state.get(f"{prefix}rig_hash"), layer.get_buffer("rig_hash").tolist()
    if found is None or found.tolist() != own:
        theirs = "is of an unknown rig" if found is None else f"is of rig {bytes(found.tolist()).hex()[:12]}"
        raise EvaluatorError(
            f"the state {theirs}; this JawLayer is of rig {bytes(own).hex()[:12]}.",
            hint="Build the layer from the rig the state was saved with.",
        )
