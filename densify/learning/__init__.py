# SPDX-License-Identifier: MIT
"""Scene flow by learning: `clips` prepares short pieces of recordings, `samples` draws pairs of
sweeps from them, `losses` are the teachers, `network` is what `training` teaches, `model_file`
reads and writes it, and `engine` takes it into the pipeline. `labels` makes flow from boxes."""
