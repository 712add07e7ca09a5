"""Hypotheses of what a scene looks like: models of some of its pairs, and what speaks for each and against it.

A hypothesis grows. Mapped from a few pairs, its models take in every other pair that agrees with them, and are mapped
again; in an ordinary scene any of them ends as the model of all pairs.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Int

from fieldstone.mapping.disambiguation.agreement import PairAgreement, agreement_with_models, contradiction
from fieldstone.mapping.disambiguation.missing_in_model import NOTHING, MissingInModel, find_missing_in_model
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.mapping.disambiguation.proposals import Proposal
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.mapping.model.working_model import to_reconstruction
from fieldstone.scene.match_graph import ImagePair, MatchGraph
from fieldstone.scene.reconstruction import Reconstruction
from fieldstone.solve.robust.two_view import degenerate

logger = logging.getLogger(__name__)

Register = Callable[[MatchGraph], list[SubModel]]
"""The sub-models of a verified graph, the one with most photos first."""

MAX_ROUNDS = 4
"""So often a hypothesis is mapped while it grows."""
MIN_MODEL_SIZE = 3
"""Photos below which a model explains nothing."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """Models, the pairs that they were mapped from, and how they fare."""

    graph: MatchGraph
    """With the pairs that are believed; the others are degenerate."""
    sub_models: tuple[SubModel, ...]
    models: tuple[Reconstruction, ...]
    agreements: Mapping[ImagePair, PairAgreement]
    """Of every verified pair, believed or not, inside a model."""
    missing: Mapping[ImagePair, MissingInModel]
    why: str = ""

    def home(self) -> dict[int, int]:
        """The model of every photo that one holds."""
        return {v: k for k, model in enumerate(self.models) for v in model.registered().tolist()}

    def contradiction(self, options: DisambiguationOptions) -> float:
        """Share of the inliers that contradict the models."""
        return contradiction(self.agreements.values(), options.agreement)

    @property
    def total_missing(self) -> MissingInModel:
        """Of all pairs together."""
        return reduce(MissingInModel.__add__, self.missing.values(), NOTHING)

    @property
    def explained(self) -> int:
        """Photos in models that are more than a pair."""
        return sum(n for n in (len(model.registered()) for model in self.models) if n >= MIN_MODEL_SIZE)


def judge(
    everything: MatchGraph, graph: MatchGraph, register: Register, options: DisambiguationOptions, why: str = ""
) -> Hypothesis:
    """Map a graph, and compare its models with all pairs.

    Args:
        everything: With all pairs, believed or not.
    """
    sub_models = tuple(register(graph))
    models = tuple(to_reconstruction(s.model, graph) for s in sub_models)
    agreements = agreement_with_models(everything, models, options.agreement)
    missing: dict[ImagePair, MissingInModel] = {}
    for model in models:
        missing |= find_missing_in_model(model, options.missing)
    return Hypothesis(graph, sub_models, models, agreements, missing, why)


def grown(everything: MatchGraph, proposal: Proposal, register: Register, options: DisambiguationOptions) -> Hypothesis:
    """Map the pairs of a proposal, and again with all pairs that agree, until no more do."""
    believed = set(proposal.pairs)
    for _ in range(MAX_ROUNDS - 1):
        found = judge(everything, with_pairs(everything, believed), register, options, proposal.why)
        larger = _larger(everything, believed, found, options)
        logger.info("%s: %d pairs, then %d", proposal.why, len(believed), len(larger))
        if larger == believed:
            return found
        believed = larger
    return judge(everything, with_pairs(everything, believed), register, options, proposal.why)


def _larger(
    everything: MatchGraph, believed: set[ImagePair], found: Hypothesis, options: DisambiguationOptions
) -> set[ImagePair]:
    """The believed pairs and those that agree, without those that contradict; all pairs of photos left outside."""
    home, limits = found.home(), options.agreement
    agreeing = {pair for pair, a in found.agreements.items() if a.agrees(limits)}
    contradicting = {pair for pair, a in found.agreements.items() if a.contradicts(limits)}
    outside = {pair for pair in verified_pairs(everything) if pair[0] not in home or pair[1] not in home}
    return (believed | agreeing | outside) - contradicting


def verified_pairs(graph: MatchGraph) -> list[ImagePair]:
    """Pairs that have inliers."""
    return [pair for pair, two_view in sorted(graph.two_views.items()) if two_view.inliers.any()]


def with_pairs(graph: MatchGraph, pairs: Collection[ImagePair]) -> MatchGraph:
    """The graph in which only these pairs are believed."""
    kept = {
        pair: two_view if pair in pairs else degenerate(len(graph.matches[pair]))
        for pair, two_view in graph.two_views.items()
    }
    return graph.with_two_views(kept)


@dataclass(frozen=True)
class Comparison:
    """What is missing in a model between photos that another hypothesis separates, and between those that it does not.

    In the model of a fold, photos of different places lie upon each other and lack what is of one place; in a true
    model they are as any others.
    """

    separated: MissingInModel
    joined: MissingInModel


def compare(first: Hypothesis, other: Hypothesis, graph: MatchGraph, options: DisambiguationOptions) -> Comparison:
    """What is missing in the first hypothesis, by what the other one says of the same photos.

    Only photos with matches of their own are asked: those taken by night share nothing with those taken by day.
    """
    sums = [NOTHING, NOTHING]
    for pair, missing in first.missing.items():
        two_view = graph.two_views.get(pair)
        if two_view is None or two_view.inliers.sum() < options.min_strong_inliers:
            continue
        joined = pair in other.agreements and not other.agreements[pair].contradicts(options.agreement)
        sums[joined] = sums[joined] + missing
    return Comparison(*sums)


def left_out_of(everything: MatchGraph, graph: MatchGraph) -> Int[np.ndarray, "n"]:
    """How many verified pairs of every photo are not believed."""
    out = np.zeros(everything.num_images, dtype=np.int64)
    for pair in set(verified_pairs(everything)) - set(verified_pairs(graph)):
        out[list(pair)] += 1
    return out


def largest_first(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """By the photos of their largest model, then by how little is missing."""

    def rank(hypothesis: Hypothesis) -> tuple[int, float]:
        return -max((len(model.registered()) for model in hypothesis.models), default=0), hypothesis.total_missing.rate

    return sorted(hypotheses, key=rank)
