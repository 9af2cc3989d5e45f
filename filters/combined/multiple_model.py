"""Multiple models: interacting (IMM) and multiple-model adaptive estimation (MMAE).

Both run the bank of `crosscomb.filters.combined.model_bank` and weigh its filters by likelihood. A model's error
lasts, so samples are no independent evidence: log likelihoods count with dt / (dt + correlation).

- `IMM` (Blom and Bar-Shalom 1988): before each step the three states are mixed by the probability that the
  car went over from one model to another; it leaves a model after `stay` seconds on average, for any model
  by its share.
- `MMAE` (Magill 1965): each filter runs for itself; no probability falls below `floor`, so that a model can
  come back. The floor gives the wrong models a say: where one is right all along, the doubt is overstated.

Both answer with the probability-weighted mean and covariance, the NIS being the weighted mean of the
filters'.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from crosscomb.filters import columns as at
from crosscomb.filters.algebra.dense import copy_into
from crosscomb.filters.base import KernelFilter, gaussian
from crosscomb.filters.combined.model_bank import (
    MODELS,
    Bank,
    Cars,
    ModelNoise,
    bank_start,
    combine,
    model_shares,
    step_models,
)  # fmt: skip
from crosscomb.models.compiled import inlined, kernel
from crosscomb.models.single_track import single_track


@inlined
def weigh(bank, prior, noise, dt):
    """Bayes: the probabilities after the update from those before it."""
    share = dt / (dt + noise.correlation)
    best, total = -math.inf, 0.0
    for i in range(MODELS):
        if prior[i] > 0.0:
            best = max(best, bank.log_likelihood[i])
    for i in range(MODELS):
        if prior[i] > 0.0:
            bank.probability[i] = prior[i] * math.exp(share * (bank.log_likelihood[i] - best))
        else:
            bank.probability[i] = 0.0
        total += bank.probability[i]
    for i in range(MODELS):
        bank.probability[i] /= total


@inlined
def interact(bank, noise, dt):
    """Mix the states as the models may have changed (IMM); `prior` of the bank gets the predicted probabilities."""
    members, prior, weights = (bank.high, bank.low, bank.kinematic), bank.prior, bank.weights
    stay = math.exp(-dt / noise.stay)
    shares = model_shares(noise)
    for j in range(MODELS):
        # Who does not stay goes to any model by its share: the shares are the chain's steady state.
        change = (1.0 - stay) * shares[j]
        prior[j] = stay * bank.probability[j] + change
        for i in range(MODELS):
            weights[i] = bank.probability[i] * change / prior[j] if prior[j] > 0.0 else 0.0
        weights[j] = 1.0 - (weights.sum() - weights[j])
        combine(bank, weights, bank.mixed_mean[j], bank.mixed_cov[j])
    for j in range(MODELS):
        copy_into(members[j].mean, bank.mixed_mean[j])
        for i in range(2):
            copy_into(members[j].cov[i], bank.mixed_cov[j, i])


@inlined
def bank_answer(bank, out):
    """Write the mixture's beta, its standard deviation, the mean NIS and the probabilities."""
    mean, cov = bank.mixed_mean[0], bank.mixed_cov[0]
    combine(bank, bank.probability, mean, cov)
    out[at.BETA], out[at.BETA_STD] = mean[1], math.sqrt(cov[1, 1])
    nis, total = 0.0, 0.0
    for i in range(MODELS):
        if math.isfinite(bank.nis[i]):
            nis += bank.probability[i] * bank.nis[i]
            total += bank.probability[i]
    out[at.NIS] = nis / total if total > 0.0 else math.nan
    copy_into(out[3:], bank.probability)


@inlined
def imm_step(bank, sample, cars, noise, dt, out):
    """One sample of the IMM; `out` ``(6,)``: beta, its standard deviation, the NIS, the probabilities."""
    if bank_start(bank, sample, cars, noise, out):
        return
    interact(bank, noise, dt)
    step_models(bank, sample, cars, noise, dt)
    weigh(bank, bank.prior, noise, dt)
    bank_answer(bank, out)


@inlined
def mmae_step(bank, sample, cars, noise, dt, out):
    """One sample of the MMAE; `out` ``(6,)``: beta, its standard deviation, the NIS, the probabilities."""
    if bank_start(bank, sample, cars, noise, out):
        return
    step_models(bank, sample, cars, noise, dt)
    weigh(bank, bank.probability, noise, dt)
    least = min(noise.floor, 1.0 / MODELS)
    for i in range(MODELS):  # the sum stays one
        bank.probability[i] = least + (1.0 - MODELS * least) * bank.probability[i]
    bank_answer(bank, out)


@kernel
def imm_run(bank, samples, cars, noise, dt, out):
    """All samples of the IMM."""
    for k in range(samples.shape[0]):
        imm_step(bank, samples[k], cars, noise, dt, out[k])


@kernel
def mmae_run(bank, samples, cars, noise, dt, out):
    """All samples of the MMAE."""
    for k in range(samples.shape[0]):
        mmae_step(bank, samples[k], cars, noise, dt, out[k])


@dataclass(frozen=True)
class _Bank(KernelFilter):
    noise: ModelNoise = ModelNoise()
    low_friction: float = 0.3

    divisors = (*KernelFilter.divisors, "surprise", "stay", "low_friction")
    extras = ("probability_dynamic [-]", "probability_low_friction [-]", "probability_kinematic [-]")

    @cached_property
    def car(self) -> Any:
        """Parameters of the car on its own friction and on low friction."""
        high = single_track(self.vehicle, self.tyre)
        return Cars(high, high._replace(friction=self.low_friction))

    def make_state(self) -> Any:
        """Make the bank before the first sample."""
        return Bank(
            gaussian(), gaussian(), gaussian(), np.full(MODELS,
            1.0 / MODELS), np.zeros(MODELS), np.zeros(MODELS),
            np.zeros((MODELS, 2)), np.zeros((MODELS, 2, 2)), np.zeros(MODELS), np.zeros(MODELS),
            np.zeros(1, dtype=np.int64),
        )  # fmt: skip


@dataclass(frozen=True)
class IMM(_Bank):
    """Interacting multiple models: single track on two frictions and the kinematic model."""

    run_kernel = staticmethod(imm_run)


@dataclass(frozen=True)
class MMAE(_Bank):
    """Multiple-model adaptive estimation: single track on two frictions and the kinematic model."""

    run_kernel = staticmethod(mmae_run)
