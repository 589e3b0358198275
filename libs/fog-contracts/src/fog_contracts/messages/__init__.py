"""Every message that crosses a process border, as frozen types; units are metres, radians and seconds, frame `map`.

One module per family of channels; all of their names are here, so that whoever uses a message need not know its family.
"""

from fog_contracts.messages.areas import *
from fog_contracts.messages.basics import *
from fog_contracts.messages.dry_runs import *
from fog_contracts.messages.fleet import *
from fog_contracts.messages.lifts import *
from fog_contracts.messages.maps import *
from fog_contracts.messages.nodes import *
from fog_contracts.messages.robots import *
from fog_contracts.messages.simulation import *
from fog_contracts.messages.views import *
