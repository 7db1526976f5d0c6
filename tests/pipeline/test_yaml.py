"""YAML from elsewhere: deep nesting is one error, whether the depth is counted here or libyaml refuses first."""

import pytest
import yaml

from trihedron.pipeline.core.files import YamlError, parse_yaml


@pytest.mark.parametrize("levels", [9, 900, 2_000, 200_000])
def test_deep_nesting_is_one_error(levels):
    with pytest.raises(YamlError, match=r"^with aliases or deep nesting$") as caught:
        parse_yaml("fx: " + "[" * levels, max_depth=8)
    assert caught.value.line == 1


def test_a_limit_of_libyaml_is_deep_nesting(monkeypatch):
    """PyYAML 6.0.4 raises this where 6.0.3 returns the events."""

    def parse(text, loader):
        mark = yaml.Mark("<unicode string>", 1003, 2, 4, None, None)
        raise yaml.scanner.ScannerError("while increasing flow level", mark, "exceeded maximum nesting depth", mark)

    monkeypatch.setattr(yaml, "parse", parse)
    with pytest.raises(YamlError, match=r"^with aliases or deep nesting$") as caught:
        parse_yaml("any")
    assert caught.value.line == 3


def test_what_is_no_yaml_is_another_error():
    with pytest.raises(YamlError, match=r"^that is not YAML \(ScannerError\)$") as caught:
        parse_yaml("a: 1\nb: '")
    assert caught.value.line == 2
