"""Scenes that repeat themselves: places that look alike match falsely, with perfect geometry, and fold a model.

A model of all pairs comes first. Where hardly a match contradicts it, it stands: that is every ordinary scene. Else
others are mapped from fewer pairs, and one of them takes its place if the photos show that the first lays different
places upon each other. Where they show nothing of the kind and the first contradicts itself, both are kept.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Int

from fieldstone.geometry.camera import Camera
from fieldstone.mapping.disambiguation.bridges import Bridge, cut_denied_bridges
from fieldstone.mapping.disambiguation.hypotheses import (
    Comparison,
    Hypothesis,
    Register,
    compare,
    grown,
    judge,
    largest_first,
    left_out_of,
    verified_pairs,
    with_pairs,
)
from fieldstone.mapping.disambiguation.options import DisambiguationOptions
from fieldstone.mapping.disambiguation.proposals import propose
from fieldstone.mapping.disambiguation.rotation_forest import lower_rate
from fieldstone.mapping.incremental.state import SubModel
from fieldstone.scene.match_graph import ImagePair, MatchGraph

logger = logging.getLogger(__name__)

MAX_CUTS = 3
"""So often a scene is mapped again without bridges that were denied."""
WHAT_WOULD_HELP = (
    "photos that also show what is around, or names in the order in which the photos were taken, would tell"
)


@dataclass(frozen=True, eq=False)
class Disambiguation:
    """The models that the photos speak for, and what to tell of it."""

    graph: MatchGraph
    """Without pairs that are not believed."""
    sub_models: tuple[SubModel, ...]
    notes: tuple[str, ...]
    left_out: Int[np.ndarray, "n"]
    """Pairs of every photo that are not believed."""
    alternative: tuple[SubModel, ...] = ()
    """Other models of the same photos, where the photos do not tell which are true."""


def disambiguate(
    graph: MatchGraph,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    register: Register,
    options: DisambiguationOptions,
) -> Disambiguation:
    """Models of the scene that do not lay different places upon each other.

    Args:
        graph: Verified.
        register: Maps a graph; asked once in an ordinary scene.

    Source:
        `heinly2014`: a finished model is asked what is missing in it. Departure: whole models are compared.
    """
    first = judge(graph, graph, register, options, "from all pairs")
    chosen, alternative, notes = first, (), ()
    if first.contradiction(options) > options.suspicion:
        chosen, alternative, notes = _most_likely(graph, first, cameras, camera_of_image, register, options)
    chosen, more = _without_denied_bridges(chosen, register, options)
    notes = (*notes, *more)
    for note in notes:
        logger.warning("%s", note)
    return Disambiguation(chosen.graph, chosen.sub_models, notes, left_out_of(graph, chosen.graph), alternative)


def _most_likely(
    graph: MatchGraph,
    first: Hypothesis,
    cameras: Sequence[Camera],
    camera_of_image: Int[np.ndarray, "n"],
    register: Register,
    options: DisambiguationOptions,
) -> tuple[Hypothesis, tuple[SubModel, ...], tuple[str, ...]]:
    """The hypothesis that the photos speak for, the other one where they do not tell, and what to say of it."""
    proposals = propose(graph, cameras, camera_of_image, options)
    others = [grown(graph, proposal, register, options) for proposal in proposals]
    others = [other for other in others if other.explained >= options.min_explained * first.explained]
    compared = {id(other): compare(first, other, graph, options) for other in others}
    better = [other for other in others if _unfolds(first, other, compared[id(other)], options)]
    share = first.contradiction(options)
    if better:
        chosen = largest_first(better)[0]
        found = compared[id(chosen)]
        return chosen, (), _notes_of_fold(graph, chosen, found, share)
    rivals = [other for other in others if compared[id(other)].separated.expected > 0.0]
    if share >= options.contradiction and rivals:  # whatever is true, the model of all pairs is not
        return rivals[0], first.sub_models, (_note_of_rivals(rivals[0], first, share),)
    rivals = [rival for rival in rivals if not _lacks_less(first, rival, options)]
    if rivals:
        return first, rivals[0].sub_models, (_note_of_rivals(first, rivals[0], share),)
    return first, (), ()


def _lacks_less(one: Hypothesis, other: Hypothesis, options: DisambiguationOptions) -> bool:
    """Whether clearly less is missing in one hypothesis, as a whole."""
    a, b = ((m.missing, m.expected) for m in (one.total_missing, other.total_missing))
    return lower_rate(a, b, options.forest, options.better)


def _note_of_rivals(chosen: Hypothesis, rival: Hypothesis, share: float) -> str:
    return (
        f"ambiguous scene: places in it look alike. {100 * share:.1f} % of the matches contradict the model of all "
        f"pairs, and nothing tells true pairs from false ones: the model that is recommended was made {chosen.why}, "
        f"the one that was made {rival.why} is kept as the alternative; {WHAT_WOULD_HELP}"
    )


def _unfolds(first: Hypothesis, other: Hypothesis, found: Comparison, options: DisambiguationOptions) -> bool:
    """Whether the first hypothesis lacks clearly more between photos that the other separates than between others, and
    the other hypothesis lacks less as a whole."""
    separated, joined = ((m.missing, m.expected) for m in (found.separated, found.joined))
    return lower_rate(joined, separated, options.forest) and _lacks_less(other, first, options)


def _notes_of_fold(graph: MatchGraph, chosen: Hypothesis, found: Comparison, share: float) -> tuple[str, ...]:
    """What was found, in numbers."""
    count = len(set(verified_pairs(graph)) - set(verified_pairs(chosen.graph)))
    return (
        "ambiguous scene: places in it look alike. In the model of all pairs, photos of different places lie upon "
        f"each other: they lack {100 * found.separated.rate:.1f} % of what they ought to share, others "
        f"{100 * found.joined.rate:.1f} %, and {100 * share:.1f} % of the matches contradict it. The model was made "
        f"{chosen.why}; {count} of {len(verified_pairs(graph))} pairs contradict it and were left out",
    )


def _without_denied_bridges(
    found: Hypothesis, register: Register, options: DisambiguationOptions
) -> tuple[Hypothesis, tuple[str, ...]]:
    """The hypothesis mapped again without the pairs across bridges that more features deny than hold."""
    notes: list[str] = []
    for _ in range(MAX_CUTS):
        across: set[ImagePair] = set()
        for model in found.models:
            part, cut = cut_denied_bridges(model, found.missing, options)
            inside = set(model.registered().tolist())
            across |= {
                pair
                for pair in verified_pairs(found.graph)
                if inside.issuperset(pair) and part[pair[0]] != part[pair[1]]
            }
            notes += [_note_of_bridge(found.graph, bridge) for bridge in cut]
        if not across:
            break
        without = with_pairs(found.graph, set(verified_pairs(found.graph)) - across)
        found = replace(judge(found.graph, without, register, options), why=found.why)
    return found, tuple(notes)


def _note_of_bridge(graph: MatchGraph, bridge: Bridge) -> str:
    a, b = (graph.names[v] for v in bridge.pair)
    return (
        f"ambiguous scene: {bridge.held} matches would join the photos around {a} to those around {b}, and "
        f"{bridge.denied:.0f} features that both ought to show are missing: they are models of their own"
    )
