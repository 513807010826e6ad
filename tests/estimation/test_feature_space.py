"""Features of one sequence: principal components inside the first mask, with one spread."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tracking3d.estimation.feature_space import SPREAD, FeatureSpace, contrast_of, feature_channels

SIZE = 24


@pytest.fixture
def mask() -> torch.Tensor:
    mask = torch.zeros(SIZE, SIZE)
    mask[4:20, 6:18] = 1
    return mask


def features(channels: int, rank: int | None = None) -> torch.Tensor:
    """Random features of a rank, with a large mean."""
    generator = torch.Generator().manual_seed(channels)
    codes = torch.randn(rank or channels, SIZE, SIZE, generator=generator)
    mixing = torch.randn(channels, rank or channels, generator=generator)
    return torch.einsum("cr,rhw->chw", mixing, codes) + 5


def test_the_components_are_those_of_the_covariance_inside_the_mask(mask):
    values = features(9)
    space = FeatureSpace.of(values, mask, 4)
    inside = values[:, mask > 0.5].T.double().numpy()
    variances = np.linalg.svd(inside - inside.mean(0), compute_uv=False) ** 2
    assert space.kept == pytest.approx(variances[:4].sum() / variances.sum(), rel=1e-6)
    projected = space.project(values)[:, mask > 0.5]
    ratios = projected.var(1, correction=0) / projected.var(1, correction=0).sum()
    np.testing.assert_allclose(ratios, variances[:4] / variances[:4].sum(), rtol=1e-4)


def test_inside_the_mask_the_features_are_centred_and_have_the_one_spread(mask):
    for factor in (1e-3, 1.0, 1e3):
        projected = FeatureSpace.of(factor * features(8), mask, 5).project(factor * features(8))
        inside = projected[:, mask > 0.5]
        assert inside.mean(1).abs().max() < 1e-4
        assert inside.var(1, correction=0).mean().sqrt() == pytest.approx(SPREAD, rel=1e-3)


def test_distances_are_kept_up_to_one_factor_where_the_rank_allows(mask):
    values = features(12, rank=3)
    space = FeatureSpace.of(values, mask, 3)
    assert space.kept == pytest.approx(1, abs=1e-6)
    before, after = values[:, mask > 0.5].T, space.project(values)[:, mask > 0.5].T
    ratio = torch.cdist(after[:50], after[50:100]) / torch.cdist(before[:50], before[50:100])
    assert float(ratio.std() / ratio.mean()) < 1e-3


def test_what_lies_outside_the_mask_does_not_choose_the_components(mask):
    values = features(8)
    disturbed = torch.where(mask > 0.5, values, 100 * torch.randn(8, SIZE, SIZE))
    assert torch.equal(
        FeatureSpace.of(values, mask, 3).components, FeatureSpace.of(disturbed, mask, 3).components
    )


def test_the_sign_of_every_component_is_fixed(mask):
    components = FeatureSpace.of(features(8), mask, 8).components
    assert (components.gather(1, components.abs().argmax(1, keepdim=True)) > 0).all()


@pytest.mark.parametrize("covered", [0, 1, 5])
def test_a_mask_of_next_to_no_pixels_takes_the_whole_window(covered):
    mask = torch.zeros(SIZE, SIZE)
    mask.view(-1)[:covered] = 1
    whole = FeatureSpace.of(features(6), torch.ones(SIZE, SIZE), 2)
    assert torch.equal(FeatureSpace.of(features(6), mask, 2).components, whole.components)


def test_features_that_do_not_vary_stay_finite(mask):
    flat = torch.full((6, SIZE, SIZE), 0.3)
    assert FeatureSpace.of(flat, mask, 3).project(flat).isfinite().all()


def test_only_encoders_with_more_channels_are_reduced():
    class Encoder:
        channels, stride, tau = 64, 1, 0.1

        @classmethod
        def from_options(cls, options):
            return cls()

        def encode(self, images):
            return images

    assert [feature_channels(Encoder(), limit) for limit in (None, 16, 64, 200)] == [64, 16, 64, 64]


@pytest.fixture
def plain_with_a_mark():
    """A grey disc, brighter to the right, with a dark stroke of 2 pixels, on a striped background."""
    y, x = np.mgrid[:96, :96]
    inside = np.hypot(x - 48, y - 48) < 36
    image = np.where(inside, 0.4 + 0.002 * x, 0.2 + 0.5 * (x // 12 % 2))
    stroke = (abs(y - 48) < 1) & (abs(x - 40) < 8)
    image[stroke] -= 0.2
    return torch.tensor(image, dtype=torch.float32).expand(3, 96, 96).contiguous(), inside, stroke


def test_the_contrast_is_that_of_marks_not_of_shading_or_the_outline(plain_with_a_mark):
    image, inside, stroke = plain_with_a_mark
    contrast = contrast_of(image, 96)[0].numpy()
    assert abs(contrast[stroke] + 0.2).max() < 0.03
    assert abs(contrast[inside & ~stroke]).mean() < 0.01
    assert contrast_of(image, 48).shape == (1, 48, 48)


def test_a_space_with_contrast_has_one_channel_more_and_the_others_as_they_were(plain_with_a_mark):
    image, inside, stroke = plain_with_a_mark
    mask = torch.from_numpy(inside).float()
    space = FeatureSpace.of(image + 0.01 * torch.randn(3, 96, 96, generator=torch.manual_seed(0)), mask, 3)
    both = space.with_contrast()
    features = both.project(image, image)
    assert features.shape == (4, 96, 96)
    torch.testing.assert_close(features[:3], space.project(image, image))
    torch.testing.assert_close(features, both.add_contrast(features[:3], image))
    assert both.add_contrast(features, image) is features  # it has it already
    assert space.add_contrast(features[:3], image).shape == (3, 96, 96)
    assert features[3].abs()[torch.from_numpy(stroke)].min() > 10 * features[3].abs()[mask > 0].median()
