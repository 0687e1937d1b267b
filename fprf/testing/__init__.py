"""Contracts of plug-ins, as functions that a plug-in's own tests call: `from fprf.testing import check_encoder`,
then `check_encoder(MyConfig())`.

Each builds the plug-in from its config, as the program does, and raises AssertionError with one sentence on the
first breach. They take a second or so on a CPU and need no data but what is passed to them.
"""

from .configs import check_config as check_config
from .data import check_capture_format as check_capture_format
from .data import check_data_manager as check_data_manager
from .data import check_parser as check_parser
from .scenes import check_content_field as check_content_field
from .scenes import check_layout as check_layout
from .scenes import check_sampler as check_sampler
from .scenes import check_semantic_field as check_semantic_field
from .styling import check_decoder as check_decoder
from .styling import check_encoder as check_encoder
from .styling import check_stylizer as check_stylizer
from .training import check_executor as check_executor
from .training import check_loss_term as check_loss_term
