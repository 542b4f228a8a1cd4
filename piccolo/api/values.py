"""The types and constants of arguments and results, for commands and applications."""

from ..cloud.cloud_settings import CloudSettings
from ..geometry.pose import Pose
from ..judge.pose_covariance import PoseCovariance
from ..judge.probability import AMBIGUOUS, LOCALIZED, NOT_LOCALIZED
from ..judge.reasons import Reason
from ..judge.result import FAILED, FORMAT, STATUSES, UNREADABLE, Result
from ..judge.result_parts import Source
from ..judge.result_photo import photo_of, read_as_localized
from ..judge.sure import SHOWN, WORTH_A_LOOK
from ..localization.means import Step, Trace
from ..localization.paper import PaperSettings
from ..problem.accuracy import Accuracy
from ..problem.settings import CoarseToFineSettings
from ..together.second_looks import Change
from ..together.series import MOST_IN_SERIES
from ..together.walk.frames import Motion

__all__ = [
    "AMBIGUOUS",
    "FAILED",
    "FORMAT",
    "LOCALIZED",
    "MOST_IN_SERIES",
    "NOT_LOCALIZED",
    "SHOWN",
    "STATUSES",
    "UNREADABLE",
    "WORTH_A_LOOK",
    "Accuracy",
    "Change",
    "CloudSettings",
    "CoarseToFineSettings",
    "Motion",
    "PaperSettings",
    "Pose",
    "PoseCovariance",
    "Reason",
    "Result",
    "Source",
    "Step",
    "Trace",
    "photo_of",
    "read_as_localized",
]
