"""Configuration of a Yamcs instance that receives plain frames and sends telecommand packets; nothing here runs on it.

The form is that of Yamcs 5.12. Its frame link takes one plain frame a datagram. Its postprocessor of PUS telecommands
fills in sequence count, length and checksum of packets.
"""

from tmtc.xtce.export import format_xtce

_SERVER = """services:
  - class: org.yamcs.http.HttpServer
    args:
      address: 127.0.0.1
      port: 8090
dataDir: data
cacheDir: cache
instances:
  - linna
"""

_PROCESSOR = """realtime:
  services:
    - class: org.yamcs.StreamTmPacketProvider
    - class: org.yamcs.StreamTcCommandReleaser
    - class: org.yamcs.tctm.StreamParameterProvider
    - class: org.yamcs.algorithms.AlgorithmManager
    - class: org.yamcs.parameter.LocalParameterManager
  config:
    subscribeAll: true
    persistParameters: false
Archive:
  services:
    - class: org.yamcs.tctm.ReplayService
"""

_CHANNEL = """      - vcId: {channel}
        ocfPresent: true
        service: PACKET
        maxPacketLength: 65542
        stream: {stream}
        packetPreprocessorClassName: org.yamcs.pus.PusPacketPreprocessor
        packetPreprocessorArgs:
          errorDetection:
            type: CRC-16-CCIIT
          pktTimeOffset: 13
          performTimeCorrelation: false
          timeEncoding:
            type: CUC
            epoch: CUSTOM
            epochUTC: "1999-12-31T23:59:28Z"
            timeIncludesLeapSeconds: true
"""

_INSTANCE = """services:
  - class: org.yamcs.archive.XtceTmRecorder
  - class: org.yamcs.archive.ParameterRecorder
  - class: org.yamcs.archive.AlarmRecorder
  - class: org.yamcs.archive.EventRecorder
  - class: org.yamcs.archive.ReplayServer
  - class: org.yamcs.parameterarchive.ParameterArchive
    args:
      realtimeFiller:
        enabled: true
  - class: org.yamcs.archive.CommandHistoryRecorder
  - class: org.yamcs.ProcessorCreatorService
    args:
      name: realtime
      type: realtime
dataLinks:
  - name: frames
    class: org.yamcs.tctm.ccsds.UdpTmFrameLink
    port: {frame_port}
    frameType: TM
    clcwStream: clcw
    goodFrameStream: good_frames
    badFrameStream: bad_frames
    spacecraftId: {spacecraft_id}
    frameLength: {frame_length}
    errorDetection: {frame_check}
    virtualChannels:
{channels}  - name: telecommands
    class: org.yamcs.tctm.TcpTcDataLink
    host: {host}
    port: {port}
    stream: tc_realtime
    commandPostprocessorClassName: org.yamcs.tctm.pus.PusCommandPostprocessor
    commandPostprocessorArgs:
      errorDetection:
        type: CRC-16-CCIIT
mdb:
  - type: xtce
    args:
      file: mdb/linna.xml
streamConfig:
  tm:
    - name: tm_realtime
      processor: realtime
    - name: tm_dump
  invalidTm: invalid_tm_stream
  cmdHist: [cmdhist_realtime]
  event: [events_realtime]
  param: [pp_realtime, sys_param]
  parameterAlarm: [alarms_realtime]
  eventAlarm: [event_alarms_realtime]
  tc:
    - name: tc_realtime
      processor: realtime
"""


def yamcs_files(
    spacecraft_id: int, frame_length: int, checksum: bool, frame_port: int, telecommands: tuple[str, int]
) -> dict[str, str]:
    """Return the files of the instance by path, relative to the folder in which Yamcs is started.

    Parameters
    ----------
    frame_length, checksum
        Octets of a frame, and whether frames end with a checksum.
    frame_port
        UDP port of the frames.
    telecommands
        Host and TCP port of the station.
    """
    streams = ((0, "tm_realtime"), (1, "tm_dump"))
    instance = _INSTANCE.format(
        spacecraft_id=spacecraft_id,
        frame_length=frame_length,
        frame_check="CRC16" if checksum else "NONE",
        frame_port=frame_port,
        host=telecommands[0],
        port=telecommands[1],
        channels="".join(_CHANNEL.format(channel=channel, stream=stream) for channel, stream in streams),
    )
    return {
        "etc/yamcs.yaml": _SERVER,
        "etc/processor.yaml": _PROCESSOR,
        "etc/yamcs.linna.yaml": instance,
        "mdb/linna.xml": format_xtce(),
    }
