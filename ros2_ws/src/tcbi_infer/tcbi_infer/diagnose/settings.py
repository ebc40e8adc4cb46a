"""How thorough a diagnosis is."""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Settings:
    """How thorough a diagnosis is."""

    refine: int = 3  # candidates that get a full fit
    per_effect: int = 2  # sites of one effect among them
    further: int = 8  # other effects that are looked at far from the base fit, where much is left unexplained
    escape: bool = True  # the base model's fit and the best candidate's look for other valleys of the loss
    rivals: bool = True  # effects that the screening did not rank are tried in the best one's place
    least_share: float = 0.2  # of the best candidate's gain in screening, that a full fit takes
    timestep: float = 0.002  # s at most, of the final fits
    coarse: float = 0.005  # s at most, of first fits; of the screening, too, but for robots on feet
    seed: int = 0
    likeness: float = 0.97  # cosine above which two candidates' signatures count as the same
    per_joint: bool = True  # try effects at every single joint
    trust_recording: bool = False  # search although the guards say that wiring, units or commands are wrong
    sealed_share: float = 0.2  # of the kinds of motion, opened at the very end


QUICK = Settings(
    refine=2, least_share=0.4, escape=False, per_joint=False, sealed_share=0.0
)  # a first answer, from few motions
