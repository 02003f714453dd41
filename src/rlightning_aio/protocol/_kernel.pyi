from rlightning_aio.protocol.exchange import arm as arm
from rlightning_aio.protocol.exchange import complete as complete
from rlightning_aio.protocol.exchange import gather as gather
from rlightning_aio.protocol.exchange import is_due as is_due
from rlightning_aio.protocol.exchange import row_step as row_step
from rlightning_aio.protocol.exchange import serve as serve
from rlightning_aio.protocol.exchange import submit as submit
