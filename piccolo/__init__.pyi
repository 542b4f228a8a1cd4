# The public names: type checkers read them here, and at run time each is imported from here at its first use.
from .api.opening import Cloud as Cloud, open_scan as open_scan
from .api.scan import Scan as Scan
from .api.scan_walk import Walk as Walk
from .apps.report.build import ReportSettings as ReportSettings, write_report as write_report
from .geometry.pose import Pose as Pose
from .judge.pose_covariance import PoseCovariance as PoseCovariance
from .judge.result import Result as Result
from .judge.result_parts import (
    Alone as Alone,
    Alternative as Alternative,
    Evidence as Evidence,
    FocalLength as FocalLength,
    Gap as Gap,
    Source as Source,
    WalkFrame as WalkFrame,
)
from .localization.paper import PaperSettings as PaperSettings
from .photo.photo import GpsPrior as GpsPrior, Photo as Photo, Prior as Prior
from .poses.bundle_adjustment import RelativePoses as RelativePoses
from .problem.accuracy import Accuracy as Accuracy
from .problem.settings import CoarseToFineSettings as CoarseToFineSettings
from .system.errors import InputError as InputError
from .together.coloring.painting import Coloring as Coloring
from .together.walk.frames import Motion as Motion

__version__: str
