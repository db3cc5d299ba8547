"""A policy: prunes the faintest, splits where gradients are large. It plans as tests/outside_policy in Rust."""

import numpy as np

import densify


@densify.policy("steady", summary="splits where gradients are large", source="an example")
class Steady:
    """# steady — prune the faintest, split where gradients are large

    Every `grow_every` steps until `grow_until`, faint Gaussians are pruned and the 5 % with the
    largest screen gradients are split.

    | name | default | range | unit | meaning |
    |---|---|---|---|---|
    | grow_every | 100 | >= 1 | steps | interval |
    | grow_until | 15000 | >= 0 | step | end (exclusive) |
    """

    grow_every: int = densify.interval(100)  # both scale with the length of the run
    grow_until: int = densify.step(15_000)

    def needs(self, scene: densify.Scene) -> densify.Needs:
        return densify.Needs(signals=["opacity", "screen_gradient", "visible_count"])

    def is_due(self, step: int) -> bool:
        return step < self.grow_until and step % self.grow_every == 0

    def plan(self, now: densify.Now, rng: densify.Rng, plan: densify.Plan) -> None:
        faint = np.flatnonzero(now["opacity"] < np.float32(0.005))
        plan.prune(densify.spare_one(faint, now["opacity"]))  # an empty model cannot grow again
        mean = densify.mean_over_views(now["screen_gradient"], now["visible_count"])
        plan.grow(densify.top_k(mean, now.rows // 20), densify.split(1.6))  # the plan counts refusals
        plan.reset("signals")
        plan.cause("steady")
