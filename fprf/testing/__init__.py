"""Contract tests for a plug-in's own package: `from fprf.testing import check_encoder`."""

from .contracts import check_capture_format as check_capture_format
from .contracts import check_config as check_config
from .contracts import check_content_field as check_content_field
from .contracts import check_data_manager as check_data_manager
from .contracts import check_decoder as check_decoder
from .contracts import check_encoder as check_encoder
from .contracts import check_executor as check_executor
from .contracts import check_layout as check_layout
from .contracts import check_loss_term as check_loss_term
from .contracts import check_parser as check_parser
from .contracts import check_sampler as check_sampler
from .contracts import check_semantic_field as check_semantic_field
from .contracts import check_stylizer as check_stylizer
