"""The paper's split of the nuScenes scenes by name (its appendix): which train, which build priors, which test.

Training scenes are the rest of the annotated scenes: all of boston-seaport and singapore-queenstown, and 32 night
scenes of singapore-hollandvillage. Priors are built, and tests run, in singapore-onenorth and singapore-hollandvillage.
"""

import re
from typing import Literal

from presight_core.errors import InputError

Role = Literal["train", "prior", "test"]

SCENE_NAME = re.compile(r"scene-\d{4}")


def _names(numbers: str) -> tuple[str, ...]:
    return tuple(f"scene-{number}" for number in numbers.split())


TEST_SCENES = _names(
    """
    0001 0003 0005 0006 0007 0008 0011 0012 0014 0015 0016 0018 0021 0022 0023 0025 0028 0029 0034 0043 0045 0046
    0051 0054 0059 0060 0061 0120 0124 0126 0127 0130 0131 0132 0134 0135 0138 0150 0151 0152 0154 0155 0157 0158
    0159 0160 0190 0191 0192 0193 0194 0221 0270 0271 0272 0273 0274 0275 0276 0277 0278 0344 0345 0346 0347 0355
    0356 0357 0358 0359 0361 0362 0363 0364 0365 0366 0367 0368 0371 0372 0373 0374 0375 0376 0377 0379 0380 0381
    0382 0383 0385 0945 0949 0952 0953 0956 0957 0958 0959 0960 0961 0963 0966 0967 0968 0969 0971 0975 0976 0977
    0978 0979 0980 0981 0982 0983 0984 0989 0990 0991 1045 1046 1047 1048 1049 1050 1051 1052 1053 1054 1055 1056
    1057 1058 1059 1060 1061 1062 1063 1064 1065 1066 1067 1068 1069 1070 1071 1072 1073 1074 1075 1076 1077 1104
    """
)
PRIOR_SCENES = _names(
    """
    0002 0004 0009 0010 0013 0017 0019 0020 0024 0026 0027 0030 0031 0032 0033 0035 0036 0038 0039 0041 0042 0044
    0047 0048 0049 0050 0052 0053 0055 0056 0057 0058 0121 0122 0123 0125 0128 0129 0133 0139 0149 0195 0196 0268
    0269 0348 0349 0350 0351 0352 0353 0354 0360 0369 0370 0378 0384 0386 0399 0400 0401 0402 0403 0405 0406 0407
    0408 0410 0411 0412 0413 0414 0415 0416 0417 0418 0419 0947 0955 0962 0972 0988
    """
)


def role_of(scene_name: str) -> Role:
    """What an annotated scene, such as "scene-0061", is for. Raises InputError for what cannot name a scene."""
    if not SCENE_NAME.fullmatch(scene_name):
        raise InputError(f"{scene_name!r} is no nuScenes scene; names are 'scene-' and four digits")
    if scene_name in TEST_SCENES:
        return "test"
    return "prior" if scene_name in PRIOR_SCENES else "train"
