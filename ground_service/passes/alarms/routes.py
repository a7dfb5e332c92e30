"""HTTP operations on alarms."""

from ground_service.access.security import Operator, Viewer, add_list
from ground_service.http.common import GroundOf, RowId
from ground_service.http.requests import operations
from ground_service.passes.alarms import service
from ground_service.passes.alarms.model import Acknowledgement, AlarmDetail, ShelveRequest

alarms = operations("alarms")


add_list(alarms, "/alarms", service.list_alarms)


@alarms.get("/alarms/{alarm_id}")
def get_alarm(ground: GroundOf, _: Viewer, alarm_id: RowId) -> AlarmDetail:
    """Show an alarm with its history."""
    return ground.read(service.get_alarm, alarm_id)


@alarms.post("/alarms/{alarm_id}/acknowledge")
def acknowledge_alarm(
    ground: GroundOf, caller: Operator, alarm_id: RowId, given: Acknowledgement = Acknowledgement()
) -> AlarmDetail:
    """Acknowledge an alarm. It is cleared when its condition has ended as well."""
    return service.acknowledge_alarm(ground, alarm_id, given.comment, actor=caller.name)


@alarms.post("/alarms/{alarm_id}/shelve")
def shelve_alarm(ground: GroundOf, caller: Operator, alarm_id: RowId, given: ShelveRequest) -> AlarmDetail:
    """Suppress an alarm until a mission time; one in the past ends this."""
    return service.shelve_alarm(ground, alarm_id, given.until.utc_ns, given.comment, actor=caller.name)
