# SPDX-License-Identifier: MIT
"""The pipeline: the steps in order (`densify.pipeline.run.run`), and what is kept between them."""
