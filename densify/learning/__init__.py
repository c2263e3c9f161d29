# SPDX-License-Identifier: MIT
"""Scene flow by learning: teachers as losses, networks, training, trained networks as engines.

``clips`` makes short pieces of recordings ready for a network, ``samples`` draws pairs of sweeps
from them, ``losses`` are the teachers, ``networks`` what is taught, ``training`` the loop,
``model_file`` the one door to trained models, and ``engine`` takes one into the pipeline.
"""
