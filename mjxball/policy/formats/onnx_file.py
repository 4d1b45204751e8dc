"""A policy as an ONNX model, with its memory as an input and an output."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper

from mjxball.control import observation as layout
from mjxball.policy.file import PolicyFile, history_of
from mjxball.policy.formats.onnx_graph import Graph, Traced
from mjxball.policy.policy import NetworkLaw, Policy

OPSET, IR_VERSION = 17, 8  # of 2022: read by every runtime of the last years
BATCH = "flights"


def onnx_model(contents: PolicyFile, name: str) -> Any:
    """The ONNX model of a policy.

    Inputs: `observation` (N, 18); with a memory of m numbers also `memory` (N, m) and `start` (N, 1) bool, true at
    the first step of a flight, where `memory` is not read. Outputs: `action` (N, 3) in [-1, 1], `command` (N, 3)
    roll [rad], pitch [rad], vertical acceleration [m/s2]; with a memory also `next_memory` (N, m).
    """
    graph, history = Graph(), history_of(contents.card)
    seen = Traced(graph, "observation", layout.OBSERVATION_SIZE)
    inputs = [_value("observation", TensorProto.FLOAT, layout.OBSERVATION_SIZE)]
    memory = history.start(seen)
    if history.size:
        inputs += [_value("memory", TensorProto.FLOAT, history.size), _value("start", TensorProto.BOOL, 1)]
        start, given = Traced(graph, "start", 1), Traced(graph, "memory", history.size)
        memory = Traced(graph, graph.add("Where", start, memory, given), history.size)
    results = dict(zip(("action", "command", "next_memory"), _answers(contents, seen, memory), strict=True))
    if not history.size:
        del results["next_memory"]
    for label, value in results.items():
        graph.nodes.append(helper.make_node("Identity", [value.name], [label], name=label))
    outputs = [_value(label, TensorProto.FLOAT, value.size) for label, value in results.items()]
    made = helper.make_graph(graph.nodes, "follower", inputs, outputs, graph.constants, doc_string=onnx_model.__doc__)
    model = helper.make_model(made, opset_imports=[helper.make_opsetid("", OPSET)], producer_name="mjxball")
    model.ir_version = IR_VERSION
    helper.set_model_props(model, {"name": name, "card": json.dumps(contents.card, sort_keys=True)})
    onnx.checker.check_model(model, full_check=True)
    return model


def _answers(contents: PolicyFile, seen: Traced, memory: Traced) -> tuple[Traced, Traced, Traced]:
    """Action, command and next memory, by the laws that fly."""
    law = NetworkLaw(Policy(contents, "traced", np.float32))
    action = law.scaled(memory, seen)
    return action, law.command(action, seen), law.remember(memory, seen, action)


def _value(name: str, kind: int, size: int | None) -> Any:
    return helper.make_tensor_value_info(name, kind, [BATCH, size])
