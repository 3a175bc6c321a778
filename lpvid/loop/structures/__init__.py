"""Model structures with ports, by name, and what starts them from records."""

from lpvid.loop._ported import AbstractPortedStructure as AbstractPortedStructure
from lpvid.loop._ported import Labels as Labels
from lpvid.loop._ported import Ports as Ports
from lpvid.loop.structures._black_box import BlackBox as BlackBox
from lpvid.loop.structures._flexible_joint import FlexibleJoint as FlexibleJoint
from lpvid.loop.structures._function import FunctionPorted as FunctionPorted
from lpvid.loop.structures._mass_spring_damper import (
    PortedMassSpringDamper as PortedMassSpringDamper,
)
from lpvid.loop.structures._model import PortedModel as PortedModel
from lpvid.loop.structures._named import STRUCTURES as STRUCTURES
from lpvid.loop.structures._named import structure_named as structure_named
from lpvid.loop.structures._servo import Servo as Servo
from lpvid.loop.structures._single_link_arm import FlexibleLink as FlexibleLink
from lpvid.loop.structures._two_link_arm import PortedTwoLinkArm as PortedTwoLinkArm
from lpvid.loop.structures._unfold import unfolded as unfolded
