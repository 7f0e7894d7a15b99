"""Checks Grafana's provisioning files and dashboards against the parts of its documented schema that they use.

    grafana_files.py FOLDER      deploy/grafana
"""
import json
import pathlib
import sys

import jsonschema
import yaml


def an_object(required, **properties):
    """Only the listed properties; those named in `required` must be there."""
    return {"type": "object", "properties": properties, "required": required.split(), "additionalProperties": False}


def a_list(items):
    return {"type": "array", "items": items, "minItems": 1}


TEXT = {"type": "string", "minLength": 1}
FLAG = {"type": "boolean"}
NUMBER = {"type": "number"}
ANY = {"type": "object"}

DATASOURCES = an_object(
    "apiVersion datasources",
    apiVersion={"const": 1},
    datasources=a_list(
        an_object(
            "name uid type access url",
            name=TEXT,
            uid=TEXT,
            type={"const": "prometheus"},
            access={"enum": ["proxy", "direct"]},
            url={"type": "string", "pattern": "^https?://"},
            isDefault=FLAG,
            editable=FLAG,
            jsonData=an_object("", httpMethod={"enum": ["GET", "POST"]}, timeInterval={"pattern": "^[0-9]+[smh]$"}),
        )
    ),
)

PROVIDERS = an_object(
    "apiVersion providers",
    apiVersion={"const": 1},
    providers=a_list(
        an_object(
            "name type options",
            name=TEXT,
            type={"const": "file"},
            folder=TEXT,
            allowUiUpdates=FLAG,
            disableDeletion=FLAG,
            updateIntervalSeconds=NUMBER,
            options=an_object("path", path={"type": "string", "pattern": "^/"}, foldersFromFilesStructure=FLAG),
        )
    ),
)

DATASOURCE = an_object("type uid", type={"const": "prometheus"}, uid=TEXT)
GRID = an_object(
    "h w x y",
    h={"type": "integer", "minimum": 1},
    w={"type": "integer", "minimum": 1, "maximum": 24},
    x={"type": "integer", "minimum": 0, "maximum": 23},
    y={"type": "integer", "minimum": 0},
)
ROW = an_object(
    "id type title gridPos panels collapsed",
    id={"type": "integer"},
    type={"const": "row"},
    title=TEXT,
    gridPos=GRID,
    collapsed={"const": False},
    panels={"maxItems": 0},
)
TARGET = an_object(
    "refId datasource expr",
    refId={"pattern": "^[A-Z]$"},
    datasource=DATASOURCE,
    expr=TEXT,
    legendFormat={"type": "string"},
)
PANEL = an_object(
    "id type title datasource targets gridPos fieldConfig",
    id={"type": "integer"},
    type={"enum": ["timeseries", "stat", "gauge"]},
    title=TEXT,
    description={"type": "string"},
    datasource=DATASOURCE,
    targets=a_list(TARGET),
    gridPos=GRID,
    options=ANY,
    fieldConfig=an_object(
        "defaults overrides",
        defaults=an_object("unit", unit=TEXT, min=NUMBER, max=NUMBER, decimals=NUMBER, custom=ANY),
        overrides={"type": "array"},
    ),
)
DASHBOARD = an_object(
    "uid title schemaVersion time panels templating",
    uid={"type": "string", "pattern": "^[A-Za-z0-9_-]{1,40}$"},
    title=TEXT,
    tags=a_list(TEXT),
    timezone=TEXT,
    schemaVersion={"type": "integer", "minimum": 36},
    editable=FLAG,
    graphTooltip={"enum": [0, 1, 2]},
    refresh={"pattern": "^[0-9]+[smh]$"},
    time=an_object("from to", **{"from": TEXT, "to": TEXT}),
    templating=an_object("list", list=a_list(ANY)),
    annotations=an_object("list", list={"type": "array"}),
    panels=a_list({"if": {"properties": {"type": {"const": "row"}}}, "then": ROW, "else": PANEL}),
)


def read(folder, pattern, schema, parse):
    paths = sorted(folder.glob(pattern))
    assert paths, f"there is no {pattern} in {folder}"
    for path in paths:
        value = parse(path.read_text(encoding="utf-8"))
        jsonschema.validate(value, schema)
        yield path, value


def main():
    folder = pathlib.Path(sys.argv[1])
    sources = read(folder, "provisioning/datasources/*.yml", DATASOURCES, yaml.safe_load)
    known = {source["uid"] for _, value in sources for source in value["datasources"]}
    list(read(folder, "provisioning/dashboards/*.yml", PROVIDERS, yaml.safe_load))
    for path, dashboard in read(folder, "dashboards/*.json", DASHBOARD, json.loads):
        ids, cells = set(), set()
        for panel in dashboard["panels"]:
            where = f"{path.name}, panel {panel['title']!r}"
            assert panel["id"] not in ids, f"{where}: its id is another panel's, too"
            ids.add(panel["id"])
            grid = panel["gridPos"]
            assert grid["x"] + grid["w"] <= 24, f"{where}: wider than the dashboard"
            covered = {(grid["x"] + i, grid["y"] + j) for i in range(grid["w"]) for j in range(grid["h"])}
            assert not covered & cells, f"{where}: lies on another panel"
            cells |= covered
            targets = panel.get("targets", [])
            assert len({target["refId"] for target in targets}) == len(targets), f"{where}: two targets of one name"
            for target in targets:
                assert target["datasource"]["uid"] in known, f"{where}: no such datasource"


main()
