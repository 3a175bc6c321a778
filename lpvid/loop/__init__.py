"""Close the loop with measured data: find the residual, trace it, add the effect, refit."""

from lpvid.loop._engine import close_the_loop as close_the_loop
from lpvid.loop._loop import Loop as Loop
from lpvid.loop._loop_model import LoopModel as LoopModel
from lpvid.loop._ported import AbstractPortedStructure as AbstractPortedStructure
from lpvid.loop._ported import Labels as Labels
from lpvid.loop._ported import Ports as Ports
from lpvid.loop._records import HOLDS as HOLDS
from lpvid.loop._result import VERDICTS as VERDICTS
from lpvid.loop._result import Candidate as Candidate
from lpvid.loop._result import Errors as Errors
from lpvid.loop._result import EstimatedNumber as EstimatedNumber
from lpvid.loop._result import FoundEffect as FoundEffect
from lpvid.loop._result import Ladder as Ladder
from lpvid.loop._result import SeatedEffect as SeatedEffect
from lpvid.loop._result import Series as Series
from lpvid.loop._result import VirtualForce as VirtualForce
from lpvid.loop.structures import STRUCTURES as STRUCTURES
from lpvid.loop.structures import structure_named as structure_named
