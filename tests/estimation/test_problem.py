"""What is minimized: the weighted sum of the terms, each evaluated on rendered frames."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import pytest
import torch
from small_scenes import observed, parameters_of, pose_of, problem_of

from tracking3d.config.models import LossWeights, PaperConfig
from tracking3d.estimation.paper.problem import Losses, Parameters
from tracking3d.estimation.shape import flatten

LOSSES = Losses(
    features=torch.tensor([0.1, 0.3]),
    silhouette=torch.tensor([0.2, 0.4]),
    distance=torch.tensor([0.01, 0.03]),
    motion=torch.tensor(0.5),
    laplacian=torch.tensor(0.002),
    total_variation=torch.tensor(7.0),
)
NOTHING = dict.fromkeys(LossWeights.model_fields, 0.0)


def test_total_is_the_weighted_sum_with_the_mean_over_frames():
    weights = LossWeights(features=2, silhouette=3, distance=5, motion=7, laplacian=11, total_variation=13)
    expected = 2 * 0.2 + 3 * (0.3 + 5 * 0.02) + 7 * 0.5 + 11 * 0.002 + 13 * 7.0
    assert LOSSES.total(weights).item() == pytest.approx(expected)


def test_weights_of_the_paper():
    expected = 0.2 + (0.3 + 0.02) + 0.5 + 1000 * 0.002 + 0.001 * 7.0
    assert LOSSES.total(PaperConfig().weights).item() == pytest.approx(expected)


@pytest.mark.parametrize(
    ("term", "value"),
    [("features", 0.2), ("silhouette", 0.3), ("motion", 0.5), ("laplacian", 0.002), ("total_variation", 7.0)],
)
def test_each_weight_alone_gives_its_own_term(term, value):
    assert LOSSES.total(LossWeights(**{**NOTHING, term: 1.0})).item() == pytest.approx(value)


def test_no_weight_no_loss():
    assert LOSSES.total(LossWeights(**NOTHING)) == 0


def test_terms_of_one_frame_by_name():
    terms = LOSSES.of_frame(1)
    assert terms == pytest.approx(
        {
            "appearance": 0.3,
            "silhouette": 0.4,
            "distance": 0.03,
            "motion": 0.5,
            "laplacian": 0.002,
            "total_variation": 7.0,
        }
    )
    assert set(terms) == set(LossWeights.model_fields) - {"features"} | {"appearance"}


def leaves(parameters: Parameters) -> Parameters:
    return Parameters(
        *(getattr(parameters, field.name).clone().requires_grad_() for field in fields(parameters))
    )


def gradients(parameters: Parameters, **solver: object) -> dict[str, float]:
    """Largest gradient of the total loss by each parameter."""
    problem = problem_of([observed(pose_of(0)), observed(pose_of(10), 1)], **solver)
    at = leaves(parameters)
    problem.losses(at).total(problem.config.weights).backward()
    found = {field.name: getattr(at, field.name).grad for field in fields(at)}
    return {name: 0.0 if value is None else value.abs().max().item() for name, value in found.items()}


DISPLACED = parameters_of([pose_of(3, x=0.05), pose_of(50, x=0.3)])
DISPLACED = replace(DISPLACED, offsets=0.02 * torch.randn_like(DISPLACED.offsets))


@pytest.mark.parametrize(
    ("term", "moved"),
    [
        ("features", {"translation", "quaternion", "offsets", "texture"}),
        ("silhouette", {"translation", "quaternion", "offsets"}),
        ("motion", {"translation", "quaternion"}),
        ("laplacian", {"offsets"}),
        ("total_variation", {"texture"}),
    ],
)
def test_each_term_pulls_on_its_own_parameters_and_weight_zero_switches_it_off(term, moved):
    pulled = gradients(DISPLACED, weights={**NOTHING, term: 1.0})
    assert {name for name, gradient in pulled.items() if gradient > 0} == moved


def test_distance_term_pulls_only_together_with_the_silhouette():
    alone = gradients(DISPLACED, weights={**NOTHING, "distance": 1.0})
    assert set(alone.values()) == {0.0}
    with_iou = gradients(DISPLACED, weights={**NOTHING, "silhouette": 1.0})
    with_both = gradients(DISPLACED, weights={**NOTHING, "silhouette": 1.0, "distance": 50.0})
    assert with_both["offsets"] != with_iou["offsets"]


def test_terms_without_weight_are_not_evaluated():
    losses = problem_of([observed(pose_of(0)), observed(pose_of(90), 1)], weights=NOTHING).losses(
        leaves(DISPLACED)
    )
    assert (losses.motion, losses.laplacian, losses.total_variation) == (0, 0, 0)


def test_the_truth_explains_its_frames():
    poses = [pose_of(0), pose_of(20)]
    problem = problem_of([observed(pose, index) for index, pose in enumerate(poses)], silhouette_bias="none")
    losses = problem.losses(parameters_of(poses))
    assert losses.features.max() < 1e-6
    assert losses.distance.max() < 0.01  # the soft band alone
    assert losses.silhouette.max() < 0.1
    assert losses.motion == 0


def test_erosion_and_softening_remove_the_bias_of_the_soft_band():
    seen = [observed(pose_of(20), size=128)]
    loss = {
        band: problem_of(seen, silhouette_bias=band).losses(parameters_of([pose_of(20)])).silhouette.item()
        for band in ("none", "erode", "soften")
    }
    assert loss["soften"] < 0.7 * loss["none"]
    assert loss["erode"] < 0.7 * loss["none"]


def test_a_frame_without_a_mask_has_no_silhouette_loss():
    problem = problem_of([observed(pose_of(0)), observed(pose_of(10), 1, has_mask=False)])
    losses = problem.losses(parameters_of([pose_of(30, x=0.4), pose_of(30, x=0.4)]))
    assert losses.silhouette[0] > 0.1
    assert losses.distance[0] > 0
    assert losses.silhouette[1] == 0
    assert losses.distance[1] == 0
    assert losses.features[1] > 0


def test_beyond_the_border_of_the_frame_nothing_is_charged():
    seen = observed(pose_of(0))
    valid = torch.zeros_like(seen.valid)
    valid[:, :24] = 1
    wrong = seen.features.clone()
    wrong[:, :, 24:] = 5.0
    poses = parameters_of([pose_of(0)])
    half = problem_of([replace(seen, valid=valid)]).losses(poses)
    assert half.features < 1e-6
    assert torch.equal(
        problem_of([replace(seen, valid=valid, features=wrong)]).losses(poses).features, half.features
    )
    mask = torch.where(valid > 0, seen.mask, 1 - seen.mask)
    changed = problem_of([replace(seen, valid=valid, mask=mask)]).losses(poses)
    assert torch.equal(changed.silhouette, half.silhouette)


def test_motion_is_measured_a_frame_from_the_last_but_one_of_the_batch():
    seen = [observed(pose_of(0), 0), observed(pose_of(0), 2), observed(pose_of(0), 6)]
    at = parameters_of([pose_of(0, x=9.0), pose_of(0), pose_of(160, x=0.8)])
    expected = (0.8 / 4 - 0.1) + math.radians(160 / 4 - 30)
    assert problem_of(seen).losses(at).motion.item() == pytest.approx(expected, rel=1e-4)
    free = problem_of(seen, motion_translation=0.2, motion_rotation=40)
    assert free.losses(at).motion.item() == pytest.approx(0, abs=1e-5)


def test_motion_can_be_measured_from_a_keyframe_outside_the_batch():
    problem = replace(problem_of([observed(pose_of(0), 6)]), previous=(pose_of(0), 4))
    assert problem.losses(parameters_of([pose_of(0, x=0.8)])).motion.item() == pytest.approx(0.3, rel=1e-4)


def test_a_frame_alone_has_no_motion():
    assert problem_of([observed(pose_of(0))]).losses(parameters_of([pose_of(90, x=1)])).motion == 0


def test_laplacian_of_the_vertices_or_of_their_offsets():
    seen = [observed(pose_of(0))]
    vertices = problem_of(seen).losses(parameters_of([pose_of(0)])).laplacian
    offsets = problem_of(seen, laplacian_of="offsets").losses(parameters_of([pose_of(0)])).laplacian
    assert vertices > 0
    assert offsets == 0


def test_pixels_of_texture_never_seen_cost_the_charge():
    problem = problem_of([observed(pose_of(0))], unseen_penalty=0.2)
    at = parameters_of([pose_of(40)])
    size = at.texture.shape[1:]
    unknown = replace(problem, seen=torch.zeros(1, *size)).losses(at).features
    known = replace(problem, seen=torch.ones(1, *size)).losses(at).features
    assert unknown.item() == pytest.approx(0.2, rel=1e-5)
    torch.testing.assert_close(known, problem_of([observed(pose_of(0))]).losses(at).features)


def test_a_tilted_sheet_is_flat_already():
    generator = torch.Generator().manual_seed(1)
    plane = torch.randn(40, 2, generator=generator) @ torch.tensor([[1.0, 0.2, 0.3], [0.1, 1.0, -0.5]])
    sheet = plane + torch.tensor([1.0, 2.0, 3.0])
    torch.testing.assert_close(flatten(sheet), sheet, rtol=0, atol=1e-5)


def test_flattening_moves_vertices_along_one_normal_onto_one_plane():
    cloud = torch.randn(60, 3, generator=torch.Generator().manual_seed(2)) * torch.tensor([2.0, 1.5, 0.2])
    flat = flatten(cloud)
    assert torch.linalg.svdvals(flat - flat.mean(0))[2] < 1e-5
    assert torch.linalg.svdvals(flat - cloud)[1] < 1e-4  # all displacements are parallel
    assert abs((flat - cloud)[:, 2]).max() > 5 * abs((flat - cloud)[:, :2]).max()
    torch.testing.assert_close(flatten(flat), flat, rtol=0, atol=1e-5)
