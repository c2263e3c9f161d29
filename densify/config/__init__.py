# SPDX-License-Identifier: MIT
"""Hold the settings (`densify.config.sections`) and resolve their values (`.resolving`)."""

from densify.config.resolving import as_mapping as as_mapping
from densify.config.resolving import presets as presets
from densify.config.resolving import resolve as resolve
from densify.config.sections import AccumulateSettings as AccumulateSettings
from densify.config.sections import Config as Config
from densify.config.sections import FlowSettings as FlowSettings
from densify.config.sections import ObjectiveSettings as ObjectiveSettings
from densify.config.sections import OutputSettings as OutputSettings
from densify.config.sections import PriorSettings as PriorSettings
from densify.config.sections import ProjectSettings as ProjectSettings
from densify.config.sections import RegisterSettings as RegisterSettings
