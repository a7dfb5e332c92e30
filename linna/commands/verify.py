"""`linna verify`: integrity check of the archive of the ground service."""

import argparse
import time

from linna.commands._ground import add_service_options, open_service
from linna.output import emit, finish, log
from linna.parser import option

LINES = 50


def configure(parser: argparse.ArgumentParser) -> None:
    option(
        parser,
        "--rebuild",
        bool,
        "also derive packets, values, roll-ups and time correlations again from the raw files and compare",
    )
    option(
        parser,
        "--head HEAD",
        str,
        "stored head of the audit chain, NUMBER:SHA256 ('linna audit head'), or a file or folder of signed heads",
    )
    add_service_options(parser)
    finish(parser, run)


def run(arguments: argparse.Namespace) -> int:
    from ground_service.worker.integrity import verify
    from ground_service.worker.upkeep import kept_heads

    head, began = arguments.head, time.monotonic()
    with open_service(arguments) as ground:
        heads = kept_heads(ground, head) if head else []
        result = verify(ground, rebuild=arguments.rebuild, heads=heads, say=log)
    figures = {**result.model_dump(), "wall_s": round(time.monotonic() - began, 3)}
    lines = [f"{one.kind} {one.key}: {one.reason}" for one in result.damaged[:LINES]]
    if result.damaged_total > len(lines):
        lines.append(f"… {result.damaged_total - len(lines)} more")
    lines += [f"not checked: {count} {reason}" for reason, count in result.unchecked.items()]
    lines.append(
        f"{result.verdict}: {sum(result.checked.values())} checked, {result.damaged_total} damaged; "
        f"audit head {result.audit_head}"
    )
    emit(arguments, figures, text="\n".join(lines))
    return 1 if result.damaged_total else 0
