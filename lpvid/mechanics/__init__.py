"""Plants built from their energies, and what excites them."""

from lpvid.mechanics._arm_structure import ArmScales as ArmScales
from lpvid.mechanics._arm_structure import DissipativeTwoLinkArm as DissipativeTwoLinkArm
from lpvid.mechanics._arm_structure import TwoLinkArmStructure as TwoLinkArmStructure
from lpvid.mechanics._arm_structure import two_link_arm_structure as two_link_arm_structure
from lpvid.mechanics._excitation import add_noise as add_noise
from lpvid.mechanics._excitation import multisine as multisine
from lpvid.mechanics._excitation import prbs as prbs
from lpvid.mechanics._lagrangian import accelerations as accelerations
from lpvid.mechanics._lagrangian import inertia_matrix as inertia_matrix
from lpvid.mechanics._lagrangian import integrate as integrate
from lpvid.mechanics._lagrangian import linearise as linearise
from lpvid.mechanics._mass_spring_damper import MassSpringDamper as MassSpringDamper
from lpvid.mechanics._mass_spring_damper import UndampedModes as UndampedModes
from lpvid.mechanics._study_records import OPERATING_POINTS as OPERATING_POINTS
from lpvid.mechanics._study_records import StudyRecords as StudyRecords
from lpvid.mechanics._study_records import local_records as local_records
from lpvid.mechanics._study_records import study_records as study_records
from lpvid.mechanics._study_records import sweep_record as sweep_record
from lpvid.mechanics._study_records import validation_record as validation_record
from lpvid.mechanics._two_link_arm import ArmMotion as ArmMotion
from lpvid.mechanics._two_link_arm import TwoLinkFlexibleArm as TwoLinkFlexibleArm
from lpvid.mechanics._two_link_arm import reference_two_link_arm as reference_two_link_arm
