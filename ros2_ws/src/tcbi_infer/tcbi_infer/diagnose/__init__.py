"""Which physical effect a model lacks: ranked evidence and a verdict that never sounds surer than the data."""

from tcbi_infer.diagnose.diagnosis import diagnose
from tcbi_infer.diagnose.evidence import Diagnosis, Evidence, ParameterEstimate

__all__ = ["Diagnosis", "Evidence", "ParameterEstimate", "diagnose"]
