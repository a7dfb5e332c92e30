"""Solve an integer program with CP-SAT of OR-Tools: JSON on stdin, JSON on stdout.

`benchmarks.planning` runs this file in the environment of requirements/ortools.txt: OR-Tools pins a version of protobuf
that the other requirements do not permit.
"""

import json
import sys

from ortools.sat.python import cp_model


def main() -> int:
    """Maximise `objective` over integers between `lower` and `upper` with each row at most its limit."""
    program = json.load(sys.stdin)
    model = cp_model.CpModel()
    bounds = zip(program["lower"], program["upper"], strict=True)
    variables = [model.new_int_var(lower, upper, "") for lower, upper in bounds]
    for columns, coefficients, limit in program["rows"]:
        chosen = [variables[k] for k in columns]
        model.add(cp_model.LinearExpr.weighted_sum(chosen, coefficients) <= limit)
    model.maximize(cp_model.LinearExpr.weighted_sum(variables, program["objective"]))
    solver = cp_model.CpSolver()
    solver.parameters.max_time_in_seconds = program["limit_s"]
    solver.parameters.num_workers = 2
    solver.parameters.random_seed = 1
    status = solver.solve(model)
    found = status in (cp_model.OPTIMAL, cp_model.FEASIBLE)
    answer = {
        "values": [solver.value(one) for one in variables] if found else None,
        "bound": solver.best_objective_bound,
    }
    json.dump(answer, sys.stdout)
    return 0


if __name__ == "__main__":
    sys.exit(main())
