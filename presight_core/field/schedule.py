"""How training changes with its progress."""

from presight_core.config import TrainingSettings

ANNEAL_SLOPE = 10.0  # released code, and mip-NeRF 360, equation 18
PROPOSAL_STRIDE = 5  # steps between updates of the proposals after the warm-up (released code)


def learning_rate(step: int, settings: TrainingSettings) -> float:
    """The learning rate of a step: a linear rise from 1 % of it, then drops by `decay`."""
    progress = step / settings.steps
    risen = min(1.0, 0.01 + 0.99 * progress / settings.warmup) if settings.warmup else 1.0
    drops = sum(progress >= share for share in settings.decay_at)
    return settings.learning_rate * risen * settings.decay**drops


def anneal_exponent(step: int, settings: TrainingSettings) -> float:
    """Exponent of the proposals' weights: near 0 at first, so that samples spread, then 1."""
    progress = min(1.0, step / (settings.anneal * settings.steps)) if settings.anneal else 1.0
    return ANNEAL_SLOPE * progress / ((ANNEAL_SLOPE - 1) * progress + 1)


def stereo_share(step: int, settings: TrainingSettings) -> float:
    """How much the depths that neighbouring images tell still count: wholly at first, then evenly less, at the end 0.

    They say where surfaces are; thin things, edges and the one in ten that is wrong are left to colours.
    """
    fading_steps = max(settings.steps - settings.stereo.fades_from, 1)
    return min(1.0, (settings.steps - step) / fading_steps)


def trains_proposals(step: int, settings: TrainingSettings) -> bool:
    """Whether the proposals learn in this step: always during the warm-up, then now and again."""
    return step < settings.warmup * settings.steps or step % PROPOSAL_STRIDE == 0
