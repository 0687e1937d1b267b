"""Contract tests for a plug-in's own package: `from fprf.testing import check_encoder`."""

from .contracts import (
    check_config,
    check_content_field,
    check_data_manager,
    check_decoder,
    check_encoder,
    check_executor,
    check_layout,
    check_loss_term,
    check_parser,
    check_sampler,
    check_semantic_field,
    check_stylizer,
)

__all__ = [
    "check_config",
    "check_content_field",
    "check_data_manager",
    "check_decoder",
    "check_encoder",
    "check_executor",
    "check_layout",
    "check_loss_term",
    "check_parser",
    "check_sampler",
    "check_semantic_field",
    "check_stylizer",
]
