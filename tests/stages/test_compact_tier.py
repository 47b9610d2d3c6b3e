"""The compact tier on real images: below its limit, and close to what the network gave."""

import cv2
import numpy as np

from presight_core import feature_codec
from presight_core.config import FeatureSettings
from presight_core.model_card import ModelCard
from stages.features import FeatureExtractor
from stages.space_fitting import fit_space

PAPER_BYTES = 60_000


def test_features_of_a_real_keyframe_keep_their_directions(shared_data):
    files = sorted((shared_data / "nuscenes-keyframe" / "samples").glob("CAM_*/*.jpg"))
    images = [cv2.imread(str(file))[..., ::-1] for file in files]
    extractor = FeatureExtractor(None, ModelCard.load("tiny", "features"))
    space = fit_space(images[:3], extractor, FeatureSettings())
    features = space.encode(extractor.raw_features(images))
    codes = [feature_codec.encode(image, space.channel_weights) for image in features]
    assert max(map(len, codes)) < PAPER_BYTES
    mean = features.mean((0, 1, 2))
    exact, compact = features - mean, np.stack([feature_codec.decode(code) for code in codes]) - mean
    lengths = np.linalg.norm(exact, axis=-1) * np.linalg.norm(compact, axis=-1)
    assert np.median((exact * compact).sum(-1) / lengths) >= 0.97


def test_a_grid_of_the_papers_size_stays_below_its_limit_even_if_it_is_noise():
    features = np.random.default_rng(0).integers(0, 256, (72, 128, 64), np.uint8)
    assert len(feature_codec.encode(features, np.ones(64))) < PAPER_BYTES
