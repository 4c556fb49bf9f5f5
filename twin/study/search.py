"""An optimiser that proposes designs: NSGA-II with the study's objectives and constraints (Deb et al. 2002)."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState

from twin.study.description import Study, Variable
from twin.study.designs import Design

JOURNAL = "optimiser.log"
_NAME = "sweep"
_POPULATION = 64


class Search:
    """The optimiser's memory lies in a journal in the study's folder, which several machines may share."""

    def __init__(self, study: Study, folder: Path):
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self._study = study
        self._space = {name: _distribution(variable) for name, variable in study.free().items()}
        journal = JournalStorage(JournalFileBackend(str(folder / JOURNAL)))
        # Several machines must not propose the same designs: the seed is for the first of them only.
        known = _NAME in optuna.get_all_study_names(journal)
        sampler = optuna.samplers.NSGAIISampler(
            population_size=_POPULATION, seed=None if known else study.sampling.seed
        )
        self._optuna = optuna.create_study(
            storage=journal, sampler=sampler, study_name=_NAME, load_if_exists=True,
            directions=[objective.goal.replace("ise", "ize") for objective in study.objectives],
        )  # fmt: skip

    def ask(self, count: int) -> list[Design]:
        """New designs."""
        trials = [self._optuna.ask(self._space) for _ in range(count)]
        free = self._study.free()
        return [Design(trial.number, {name: free[name].taken(trial.params[name]) for name in free}) for trial in trials]

    def tell(self, columns: dict[str, np.ndarray]) -> None:
        """What the designs are worth, in columns as `judged` returns them; those told before are left alone."""
        trials = {trial.number: trial for trial in self._optuna.get_trials(deepcopy=False)}
        for place, number in enumerate(columns["design"].tolist()):
            trial = trials.get(number)
            if trial is None or trial.state != TrialState.RUNNING:
                continue
            values = [float(columns[objective.figure][place]) for objective in self._study.objectives]
            violation = float(columns["violation"][place])
            if math.isfinite(violation) and all(map(math.isfinite, values)):
                Trial(self._optuna, trial._trial_id).set_constraint("violation", violation)
                self._optuna.tell(number, values)
            else:
                self._optuna.tell(number, state=TrialState.FAIL)


def _distribution(variable: Variable) -> BaseDistribution:
    if variable.values is not None:
        return CategoricalDistribution(variable.values)
    return FloatDistribution(variable.least, variable.most, log=variable.scale == "log")
