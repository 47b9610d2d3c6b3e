"""A workspace whose catalog and store are on servers: what a team with many machines has."""

import pytest

from presight_core.priors.reader import PriorReader
from tests.storage.catalogs import new_postgres
from tests.torture.toy_city import CITY, ToyCity

pytestmark = pytest.mark.slow


def test_a_city_is_built_with_catalog_and_store_at_urls_and_nothing_else_but_settings_in_the_folder(
    postgres, s3, tmp_path
):
    city = ToyCity(tmp_path / "workspace", tmp_path / "data", side_blocks=2)
    catalog, caches = new_postgres(postgres), tmp_path / "caches"
    city.root.mkdir()
    settings = {"catalog": catalog, "store": s3, "caches": str(caches)}
    lines = [f'{name} = "{value}"' for name, value in settings.items()]
    (city.root / "presight.toml").write_text("\n".join(lines))
    city.prepare()
    city.ingest()
    assert city.build() == 1
    assert {build.state for build in city.workspace.catalog().builds(CITY)} == {"published"}
    assert sorted(PriorReader.open(s3, CITY).tiles) == ["t000", "t001"]
    assert sorted(path.name for path in city.root.iterdir()) == ["cities", "presight.toml"]
