"""Specifications: dataset and method files, read from TOML, validated and frozen.

Here live the keys that a file may hold, their ranges and defaults, where files are found, and the
one-line message for each mistake. Nothing here builds a mesh or imports a method, except to check
the hyperparameters of a method against its class.

Start reading with `dataset_spec.py` and `method_spec.py`; `spec_files.py` reads the files.
"""

from mor_bench.specs.base import MAX_COUNT
from mor_bench.specs.battery import Battery, Race
from mor_bench.specs.dataset_spec import (
    CONTACT,
    NO_EQUATIONS,
    NO_FORCES,
    AnyDatasetSpec,
    DatasetSpec,
    ImportedDatasetSpec,
    Observed,
    generated,
)
from mor_bench.specs.geometry_spec import (
    BoxGeometry,
    ChamberedGeometry,
    FileGeometry,
    LShapeGeometry,
    TetrahedraGeometry,
    TubeGeometry,
    VoxelsGeometry,
)
from mor_bench.specs.instrument_spec import Instrument, PlaneInstrument, SphereInstrument
from mor_bench.specs.load_ranges import Sampling
from mor_bench.specs.loads_spec import (
    AnyLoads,
    AnyTable,
    Contact,
    LineLoads,
    Loads,
    Motion,
    PointLoads,
    Pressure,
    Several,
    tables_of,
    with_seed,
)
from mor_bench.specs.material_spec import (
    FibreMaterial,
    MooneyRivlinMaterial,
    OgdenMaterial,
    SolverName,
    TwoLameMaterial,
    YeohMaterial,
)
from mor_bench.specs.method_spec import MethodSpec, all_configurations, check_method
from mor_bench.specs.one_line_errors import listed
from mor_bench.specs.parameters import check_parameters, load_class
from mor_bench.specs.region_spec import (
    BoxRegion,
    NearestRegion,
    NearSurfaceRegion,
    PlaneRegion,
    PointSetRegion,
    Region,
    SphereRegion,
)
from mor_bench.specs.sampled_parameters import (
    LIMITS,
    SampledParameters,
    material_with,
    wrong_parameters,
)
from mor_bench.specs.source_file import RECORDED, SourceFile
from mor_bench.specs.spec_files import (
    as_spec,
    is_method_file,
    load_dataset_spec,
    load_generated_spec,
    load_method_spec,
    load_recorded_spec,
)
from mor_bench.specs.split_spec import Split, SplitBy
from mor_bench.specs.suite_folder import find_suite, list_suite
from mor_bench.specs.support_spec import AXES, Support

__all__ = [
    "AXES",
    "CONTACT",
    "LIMITS",
    "MAX_COUNT",
    "NO_EQUATIONS",
    "NO_FORCES",
    "RECORDED",
    "AnyDatasetSpec",
    "AnyLoads",
    "AnyTable",
    "Battery",
    "BoxGeometry",
    "BoxRegion",
    "ChamberedGeometry",
    "Contact",
    "DatasetSpec",
    "FibreMaterial",
    "FileGeometry",
    "ImportedDatasetSpec",
    "Instrument",
    "LShapeGeometry",
    "LineLoads",
    "Loads",
    "MethodSpec",
    "MooneyRivlinMaterial",
    "Motion",
    "NearSurfaceRegion",
    "NearestRegion",
    "Observed",
    "OgdenMaterial",
    "PlaneInstrument",
    "PlaneRegion",
    "PointLoads",
    "PointSetRegion",
    "Pressure",
    "Race",
    "Region",
    "SampledParameters",
    "Sampling",
    "Several",
    "SolverName",
    "SourceFile",
    "SphereInstrument",
    "SphereRegion",
    "Split",
    "SplitBy",
    "Support",
    "TetrahedraGeometry",
    "TubeGeometry",
    "TwoLameMaterial",
    "VoxelsGeometry",
    "YeohMaterial",
    "all_configurations",
    "as_spec",
    "check_method",
    "check_parameters",
    "find_suite",
    "generated",
    "is_method_file",
    "list_suite",
    "listed",
    "load_class",
    "load_dataset_spec",
    "load_generated_spec",
    "load_method_spec",
    "load_recorded_spec",
    "material_with",
    "tables_of",
    "with_seed",
    "wrong_parameters",
]
