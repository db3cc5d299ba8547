"""`vanilla` in Python; the tests compare its models with those of the one in Rust, byte for byte."""

from __future__ import annotations

import numpy as np

import densify


@densify.policy("vanilla_in_python", summary="vanilla, for comparison", source="Kerbl et al. 2023")
class Vanilla:
    """# vanilla_in_python — the original adaptive density control

    | name | default | range | unit | meaning |
    |---|---|---|---|---|
    | grow_from | 500 | >= 0 | step | start of growth and pruning (exclusive) |
    | grow_until | 15000 | >= 0 | step | end of growth, pruning and opacity resets (exclusive) |
    | grow_every | 100 | >= 0 | steps | interval of growth and pruning; 0: never |
    | tau | 0.0002 | >= 0 | 1 / NDC | screen gradient from which a Gaussian is densified |
    | small | 0.01 | >= 0 | scene extent | largest size that is cloned; larger ones are split |
    | split_factor | 1.6 | 1 to 100 | | a split divides the scales by this |
    | min_opacity | 0.005 | 0 to 1 | | Gaussians below this opacity are pruned |
    | max_scale | 0.1 | > 0 | scene extent | Gaussians above this size are pruned |
    | max_scale_from | 3000 | >= 0 | step | start of pruning by size (exclusive) |
    | reset_every | 3000 | >= 0 | steps | interval of opacity resets; 0: never |
    | reset_opacity | 0.01 | 0 to 1, both excluded | | largest opacity after a reset |
    | white_reset_at | 500 | >= 0 | step | one more reset, on a white background only; 0: never |
    | governor | false | | | follow a growth curve instead of `tau` |
    """

    grow_from: int = densify.step(500)
    grow_until: int = densify.step(15_000)
    grow_every: int = densify.interval(100)
    tau: float = 2e-4
    small: float = 0.01
    split_factor: float = 1.6
    min_opacity: float = 0.005
    max_scale: float = 0.1
    max_scale_from: int = densify.step(3000)
    reset_every: int = densify.interval(3000)
    reset_opacity: float = 0.01
    white_reset_at: int = densify.step(500)
    governor: bool = False
    white: bool = densify.state(False)

    def needs(self, scene: densify.Scene) -> densify.Needs:
        self.white = scene.white_background
        return densify.Needs(signals=["visible_count", "screen_gradient", "opacity", "scale_max"])

    def _grows(self, step: int) -> bool:
        within = self.grow_from < step < self.grow_until
        return self.grow_every > 0 and within and step % self.grow_every == 0

    def _resets(self, step: int) -> bool:
        regular = self.reset_every > 0 and 0 < step < self.grow_until and step % self.reset_every == 0
        return regular or (self.white and 0 < step == self.white_reset_at < self.grow_until)

    def is_due(self, step: int) -> bool:
        return self._grows(step) or self._resets(step)

    def plan(self, now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        if self._grows(now.step):
            plan.cause("densify")
            self._densify(now, plan)
            plan.reset(["visible_count", "screen_gradient"])
        if self._resets(now.step):
            plan.cause("reset")
            plan.clamp_opacity(self.reset_opacity)

    def _densify(self, now: densify.Now, plan: densify.Plan) -> None:
        opacity, scale, extent = now["opacity"], now["scale_max"], now.scene.extent
        gradient = densify.mean_over_views(now["screen_gradient"], now["visible_count"])
        limits_size = now.step > self.max_scale_from
        limit = np.float32(self.max_scale * extent if limits_size else np.inf)
        factor = np.float32(self.split_factor)
        is_small = scale <= np.float32(self.small * extent)

        def dies(scale: np.ndarray) -> np.ndarray:
            broken = ~(np.isfinite(opacity) & np.isfinite(scale))
            return broken | (opacity < np.float32(self.min_opacity)) | (scale > limit)

        wanted = gradient > 0 if self.governor else gradient >= np.float32(self.tau)
        parents = np.flatnonzero(wanted & ~dies(np.where(is_small, scale, scale / factor)))
        count = max(self._allowed(now) - now.rows, 0) if self.governor else len(parents)
        # In the order of their gradients, clones and splits mixed, as the budget may end anywhere.
        order = densify.largest(parents, gradient, count)
        kinds = is_small[order]
        for part in np.split(order, np.flatnonzero(np.diff(kinds)) + 1):
            if len(part) > 0:
                plan.grow(part, densify.clone() if is_small[part[0]] else densify.split(self.split_factor))
        dead = np.flatnonzero(dies(scale) & plan.free)
        plan.prune(densify.spare_one(dead, opacity))

    def _allowed(self, now: densify.Now) -> int:
        if self.grow_every == 0:
            return now.scene.initial_rows
        events = max(max(self.grow_until - self.grow_from, 0) // self.grow_every, 1)
        event = max(now.step // self.grow_every - self.grow_from // self.grow_every, 0)
        x = min(event / events, 1.0)
        start, end = float(now.scene.initial_rows), float(now.scene.budget)
        return int(np.floor(start + (end - start) * (2.0 * x - x * x)))
