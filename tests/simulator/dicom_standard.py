"""The tables of the DICOM standard for `dicom_validator`, without the network.

The validator usually downloads the standard. highdicom ships the modules of every IOD and the
types of their attributes, so its tables are put into the validator's form here. They know no
conditions: type 1C and 2C attributes and conditional modules are checked where they are present.
"""

from functools import lru_cache
from typing import Any

from dicom_validator.validator.dicom_info import DicomInfo
from dicom_validator.validator.error_handler import NullValidationResultHandler
from dicom_validator.validator.iod_validator import IODValidator
from dicom_validator.validator.validation_result import Status
from highdicom._standard_utils import (
    get_iod_module_map,
    get_module_attribute_map,
    get_sop_class_iod_map,
)
from pydicom.datadict import tag_for_keyword
from pydicom.dataset import Dataset


def violations(dataset: Dataset) -> list[str]:
    """What the validator finds wrong, a line each: module, attribute, error."""
    handler = NullValidationResultHandler()
    validator = IODValidator(dataset, _info(str(dataset.SOPClassUID)), error_handler=handler)
    result = validator.validate()
    if result.status not in (Status.Passed, Status.Failed):
        return [str(result.status)]
    return [
        f"{module}: {tag} {error.code}"
        for module, errors in (result.module_errors or {}).items()
        for tag, error in errors.items()
    ]


@lru_cache
def _info(sop_class_uid: str) -> DicomInfo:
    iod = get_sop_class_iod_map()[sop_class_uid]
    used = {module["key"]: module["usage"] for module in get_iod_module_map()[iod]}
    modules = {
        name: {"ref": name, "use": "M" if usage == "M" else "U"} for name, usage in used.items()
    }
    iods = {sop_class_uid: {"title": iod, "modules": modules, "group_macros": {}}}
    return DicomInfo(dictionary={}, iods=iods, modules={name: _attributes(name) for name in used})


def _attributes(module: str) -> dict[str, Any]:
    top: dict[str, Any] = {}
    for attribute in get_module_attribute_map()[module]:
        if tag_for_keyword(attribute["keyword"]) is None:
            continue  # a repeating group: overlays
        level = top
        for keyword in attribute["path"]:
            level = level[_tag(keyword)].setdefault("items", {})
        level[_tag(attribute["keyword"])] = {
            "name": attribute["keyword"],
            "type": attribute["type"],
        }
    return top


def _tag(keyword: str) -> str:
    tag = tag_for_keyword(keyword)
    assert tag is not None, keyword
    return f"({tag >> 16:04X},{tag & 0xFFFF:04X})"
