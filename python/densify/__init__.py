"""densify trains 3D Gaussian Splatting scenes under a memory budget that is never exceeded.

    import densify

    run = densify.train("scene:spheres", iterations=2000, budget="5k", eval=True)
    print(run.scores)

Policies, which decide where Gaussians are added and pruned, can be written in Python: see ``densify.policy``.
"""

from __future__ import annotations

import sys as _sys

# rust-numpy needs numpy, and reports its absence less well.
import numpy as _numpy

from . import _densify
from ._densify import (
    Now,
    Plan,
    Points,
    Rng,
    View,
    largest,
    mean_over_views,
    quantile,
    smallest,
    spare_one,
    top_k,
)
from ._densify import Scene as Scene
from ._densify import __version__ as __version__
from ._edits import (
    Offspring,
    Rule,
    along,
    axes,
    by,
    clone,
    long_axis,
    offset,
    split,
    split_long_axis,
    to,
)
from ._errors import DensifyError, DeviceError, InputError, Interrupted, PolicyError, Undeclared
from ._needs import (
    Aux,
    Cadence,
    Candidates,
    ErrorScore,
    Fade,
    LossTerms,
    MaskTerm,
    Needs,
    NoiseTerm,
    PixelMap,
    Rate,
    Rates,
    SignalInfo,
    Start,
    signals,
)
from ._policy import PolicyInfo, check_policy, import_policies, interval, policies, policy, state, step
from ._opened import Scores, cameras, evaluate, export, render
from ._run import Run
from ._scenes import Camera, Dataset, Model, Rendering, write_dataset
from ._tools import Attempt, Comparison, Compressed, Page, compare, compress, scenegen, view
from ._train import Buffer, MemoryPlan, Step, Trainer, plan, prepare, train

__all__ = [
    "Attempt",
    "Aux",
    "Buffer",
    "Cadence",
    "Camera",
    "Candidates",
    "Comparison",
    "Compressed",
    "Dataset",
    "DensifyError",
    "DeviceError",
    "ErrorScore",
    "Fade",
    "InputError",
    "Interrupted",
    "LossTerms",
    "MaskTerm",
    "MemoryPlan",
    "Model",
    "Needs",
    "NoiseTerm",
    "Now",
    "Offspring",
    "Page",
    "PixelMap",
    "Plan",
    "Points",
    "PolicyError",
    "PolicyInfo",
    "Rate",
    "Rates",
    "Rendering",
    "Rng",
    "Rule",
    "Run",
    "Scene",
    "Scores",
    "SignalInfo",
    "Start",
    "Step",
    "Trainer",
    "Undeclared",
    "View",
    "along",
    "axes",
    "by",
    "cameras",
    "check_policy",
    "clone",
    "compare",
    "compress",
    "evaluate",
    "export",
    "import_policies",
    "interval",
    "largest",
    "long_axis",
    "mean_over_views",
    "offset",
    "plan",
    "policies",
    "policy",
    "prepare",
    "quantile",
    "render",
    "scenegen",
    "signals",
    "smallest",
    "spare_one",
    "split",
    "split_long_axis",
    "state",
    "step",
    "to",
    "top_k",
    "train",
    "view",
    "write_dataset",
]

# Runs of other processes are started with this interpreter, and find the package as this process has.
_densify.initialise([_sys.executable, "-m", "densify"], _densify.__file__)
