# SPDX-License-Identifier: MIT
"""Run the pipeline stages in order (`densify.pipeline.run.run`), and cache their results."""
