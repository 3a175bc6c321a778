"""Monte Carlo studies: any pipeline over random keys and operating points, in one batch."""

from lpvid.montecarlo._run import Study as Study
from lpvid.montecarlo._run import run as run
from lpvid.montecarlo._summary import Summary as Summary
from lpvid.montecarlo._summary import summarise as summarise
