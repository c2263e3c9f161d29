# SPDX-License-Identifier: MIT
"""Learn scene flow.

`clips` prepares short series of sweeps. `samples` draws pairs of sweeps from them and defines the
losses. `training` trains the `network`, and `engine` uses it in the pipeline. `labels` makes flow
from boxes.
"""
