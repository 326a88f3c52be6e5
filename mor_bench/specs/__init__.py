"""Dataset and method files: TOML read into validated, frozen specs."""

from mor_bench.specs.all_specs import (
    NO_EQUATIONS as NO_EQUATIONS,
)
from mor_bench.specs.all_specs import (
    NO_FORCES as NO_FORCES,
)
from mor_bench.specs.all_specs import (
    AnyDatasetSpec as AnyDatasetSpec,
)
from mor_bench.specs.all_specs import (
    BoxGeometry as BoxGeometry,
)
from mor_bench.specs.all_specs import (
    BoxRegion as BoxRegion,
)
from mor_bench.specs.all_specs import (
    DatasetSpec as DatasetSpec,
)
from mor_bench.specs.all_specs import (
    FileGeometry as FileGeometry,
)
from mor_bench.specs.all_specs import (
    ImportedDatasetSpec as ImportedDatasetSpec,
)
from mor_bench.specs.all_specs import (
    Loads as Loads,
)
from mor_bench.specs.all_specs import (
    LShapeGeometry as LShapeGeometry,
)
from mor_bench.specs.all_specs import (
    MethodSpec as MethodSpec,
)
from mor_bench.specs.all_specs import (
    MooneyRivlinMaterial as MooneyRivlinMaterial,
)
from mor_bench.specs.all_specs import (
    NearestRegion as NearestRegion,
)
from mor_bench.specs.all_specs import (
    NearSurfaceRegion as NearSurfaceRegion,
)
from mor_bench.specs.all_specs import (
    OgdenMaterial as OgdenMaterial,
)
from mor_bench.specs.all_specs import (
    PointSetRegion as PointSetRegion,
)
from mor_bench.specs.all_specs import (
    Region as Region,
)
from mor_bench.specs.all_specs import (
    Sampling as Sampling,
)
from mor_bench.specs.all_specs import (
    SolverName as SolverName,
)
from mor_bench.specs.all_specs import (
    SourceFile as SourceFile,
)
from mor_bench.specs.all_specs import (
    SphereRegion as SphereRegion,
)
from mor_bench.specs.all_specs import (
    Split as Split,
)
from mor_bench.specs.all_specs import (
    SplitBy as SplitBy,
)
from mor_bench.specs.all_specs import (
    TetrahedraGeometry as TetrahedraGeometry,
)
from mor_bench.specs.all_specs import (
    TwoLameMaterial as TwoLameMaterial,
)
from mor_bench.specs.all_specs import (
    VoxelsGeometry as VoxelsGeometry,
)
from mor_bench.specs.all_specs import (
    check_method as check_method,
)
from mor_bench.specs.all_specs import (
    check_parameters as check_parameters,
)
from mor_bench.specs.all_specs import (
    find_suite as find_suite,
)
from mor_bench.specs.all_specs import (
    generated as generated,
)
from mor_bench.specs.all_specs import (
    is_method_file as is_method_file,
)
from mor_bench.specs.all_specs import (
    list_suite as list_suite,
)
from mor_bench.specs.all_specs import (
    load_class as load_class,
)
from mor_bench.specs.all_specs import (
    load_dataset_spec as load_dataset_spec,
)
from mor_bench.specs.all_specs import (
    load_generated_spec as load_generated_spec,
)
from mor_bench.specs.all_specs import (
    load_method_spec as load_method_spec,
)
