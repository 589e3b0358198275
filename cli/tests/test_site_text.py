"""A site that is written as text is read as the same site."""

import tomllib

import msgspec
import pytest

from fog_contracts.site import AreaSite, Place, Site
from fognav.site_files import to_toml

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


@pytest.mark.parametrize("text", ["Hall", 'the "blue" door', "C:\\new", "two\nlines\tand\x00\x7f", "Büro 🏢"])
@pytest.mark.parametrize("number", [None, 0, 4])
def test_name_labels_and_number_of_a_written_site_are_read_as_they_were(text, number):
    area = AreaSite(id="z1", label=text, polygon=SQUARE, number=number)
    site = Site(id="office", name=text, map="map.yaml", places={"a": Place(x=1.0, y=2.0, label=text)}, areas=[area])
    assert msgspec.convert(tomllib.loads(to_toml(site)), Site) == site
