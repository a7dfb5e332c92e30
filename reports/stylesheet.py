"""The style of every report page: one sheet for screen (light and dark) and for A4 paper."""

from reports.figures.theme import DARK, LIGHT

_PAGE = """
*,*::before,*::after{box-sizing:border-box}
html{-webkit-text-size-adjust:100%;scroll-behavior:smooth}
body{margin:0;background:var(--f-paper);color:var(--f-ink);font:400 16px/1.55 var(--sans);
 font-kerning:normal;text-rendering:optimizeLegibility}
a{color:var(--accent);text-decoration-thickness:1px;text-underline-offset:.15em}
a:focus-visible,summary:focus-visible{outline:2px solid var(--accent);outline-offset:3px}
.skip{position:absolute;left:-99rem}.skip:focus{left:1rem;top:1rem;background:var(--f-paper);padding:.5rem}
.sheet{display:grid;grid-template-columns:minmax(0,60rem);justify-content:center;padding:2.5rem 1.5rem 5rem}
.contents{display:none}
main{min-width:0}
.kicker{display:flex;max-width:none;justify-content:space-between;gap:2rem;margin:0 0 1.1rem;padding-bottom:.55rem;
 border-bottom:2px solid var(--f-ink);font-size:.82rem;letter-spacing:.06em;text-transform:uppercase}
.kicker b{font-weight:650}.kicker span{color:var(--f-muted);letter-spacing:.02em;text-transform:none;
 font-variant-numeric:tabular-nums}
h1{margin:0 0 .5rem;font-size:2.15rem;line-height:1.15;font-weight:650;letter-spacing:-.018em;text-wrap:balance}
.about{display:flex;flex-wrap:wrap;gap:.15rem 2rem;margin:0 0 2rem;color:var(--f-muted);font-size:.92rem}
.about div{display:flex;gap:.5em}.about dt{color:var(--f-muted)}
.about dd{margin:0;color:var(--f-ink);font-variant-numeric:tabular-nums}
.verdict{margin:0 0 1.9rem;padding:.15rem 0 .2rem 1.15rem;border-left:5px solid var(--f-gray2);max-width:52rem}
.verdict .word{margin:0 0 .25rem;font-size:.82rem;font-weight:650;letter-spacing:.06em;text-transform:uppercase;
 color:var(--f-muted)}
.verdict .says{margin:0;font-size:1.28rem;line-height:1.42;letter-spacing:-.006em;text-wrap:pretty}
.verdict.green{border-color:var(--f-green)}.verdict.green .word{color:var(--good)}
.verdict.orange{border-color:var(--f-orange)}.verdict.orange .word{color:var(--caution)}
.verdict.vermillion{border-color:var(--f-vermillion)}.verdict.vermillion .word{color:var(--bad)}
.headline{display:grid;grid-template-columns:repeat(5,minmax(0,1fr));margin:0;border-top:1px solid var(--rule);
 border-bottom:1px solid var(--rule)}
.headline>div{display:flex;flex-direction:column;padding:.85rem .9rem .8rem;border-left:1px solid var(--rule)}
.headline>div:first-child{border-left:0;padding-left:0}
.headline dt{min-height:2.6em;font-size:.86rem;line-height:1.3;color:var(--f-muted)}
.headline dd{margin:0}
.headline .number{display:flex;flex-wrap:wrap;align-items:baseline;column-gap:.3rem;
 margin:.1rem 0 .1rem;font-size:2.05rem;line-height:1.2;font-weight:600;letter-spacing:-.02em;
 font-variant-numeric:tabular-nums lining-nums}
.headline .number.words{font-size:1.15rem;letter-spacing:0;white-space:normal;padding:.45rem 0 .4rem}
.headline .number small{white-space:nowrap;line-height:1.3;font-size:.95rem;font-weight:450;
 letter-spacing:0;color:var(--f-muted)}
.headline .note{font-size:.8rem;line-height:1.35;color:var(--f-muted)}
.headline .level{margin-top:auto;padding-top:.5rem;font-size:.76rem;color:var(--f-muted)}
.level i{display:inline-block;width:.62em;height:.62em;margin-right:.16em;border:1px solid var(--f-gray2);
 border-radius:50%;vertical-align:-.02em}
.level i.on{background:var(--accent);border-color:var(--accent)}
.ladder{margin:.55rem 0 2rem;font-size:.82rem;color:var(--f-muted)}
h2{display:flex;gap:.7em;margin:3rem 0 .9rem;padding-top:.75rem;border-top:1px solid var(--f-ink);
 font-size:1.36rem;line-height:1.25;font-weight:650;letter-spacing:-.01em}
h2 .n{color:var(--f-muted);font-weight:450;font-variant-numeric:tabular-nums}
h3{margin:2rem 0 .5rem;font-size:1.03rem;line-height:1.3;font-weight:650}
p{margin:0 0 .9rem;max-width:46rem;text-wrap:pretty}
p.small{font-size:.86rem;color:var(--f-muted)}
figure{margin:1.3rem 0 1.9rem}
figure svg{display:block;width:100%;height:auto;stroke-linejoin:round;stroke-linecap:butt;overflow:visible}
figure svg text{font-family:var(--sans);font-variant-numeric:tabular-nums}
figcaption,caption{font-size:.88rem;line-height:1.45;color:var(--f-muted);text-align:left;text-wrap:pretty}
figcaption{margin-top:.5rem;max-width:52rem}
figcaption b,caption b{color:var(--f-ink);font-weight:650}
.tablewrap{margin:1.4rem 0 2rem;overflow-x:auto}
table{width:100%;border-collapse:collapse;font-size:.9rem;line-height:1.35;
 font-variant-numeric:tabular-nums lining-nums}
table.narrow{width:auto;min-width:24rem}
caption{padding-bottom:.5rem;max-width:52rem}
th,td{padding:.34rem .7rem;vertical-align:baseline;text-align:left;font-weight:400}
th:first-child,td:first-child{padding-left:0}th:last-child,td:last-child{padding-right:0}
thead th{vertical-align:bottom;color:var(--f-muted);font-size:.84rem;line-height:1.25}
thead tr:first-child>*{border-top:1.5px solid var(--f-ink)}thead tr:last-child th{border-bottom:1px solid var(--f-ink)}
thead th.group{text-align:center;color:var(--f-ink);padding-bottom:0}
thead th.group:last-child{padding-right:0}
.group span{display:block;padding-bottom:.2rem;border-bottom:1px solid var(--f-gray3)}
thead th .unit{display:block;font-weight:400}
tbody tr+tr>*{border-top:1px solid var(--f-grid)}
tbody tr:last-child>*{border-bottom:1px solid var(--f-ink)}
tbody th{min-width:7rem;overflow-wrap:break-word}
.num{text-align:right}
td.num,th.num{white-space:nowrap}
td b,th b{font-weight:650}
.swatch{display:inline-block;width:.72em;height:.72em;margin-right:.55em;border-radius:2px;vertical-align:-.04em;
 print-color-adjust:exact;-webkit-print-color-adjust:exact}
td.bar{min-width:9rem}
.gauge{display:inline-block;width:100%;max-width:16rem;height:.55em;background:var(--f-grid);vertical-align:.05em}
.gauge i{display:block;height:100%;background:var(--f-blue);print-color-adjust:exact;-webkit-print-color-adjust:exact}
.tablenote{margin:.5rem 0 0;font-size:.84rem;color:var(--f-muted);max-width:52rem}
.pairs{display:grid;grid-template-columns:minmax(9rem,15rem) minmax(0,1fr);margin:1rem 0 1.6rem;font-size:.92rem;
 border-top:1px solid var(--rule)}
.pairs dt,.pairs dd{margin:0;padding:.32rem 0;border-bottom:1px solid var(--f-grid)}
.pairs dt{padding-right:1rem;color:var(--f-muted)}
.pairs dd{overflow-wrap:anywhere;font-variant-numeric:tabular-nums}
.pairs.mono dd{font:.86em/1.5 var(--mono)}
ul{margin:.4rem 0 1.2rem;padding-left:1.15rem;max-width:46rem}li{margin:.2rem 0}
.absent{display:grid;grid-template-columns:auto 1fr;gap:0 .9rem;margin:1rem 0 1.5rem;padding:.7rem 1rem;max-width:52rem;
 border:1px dashed var(--f-faint);font-size:.92rem}
.absent b{font-weight:650}.absent span{color:var(--f-muted)}
details{margin:1rem 0}summary{cursor:pointer;font-size:.92rem;font-weight:650}
pre{margin:.6rem 0;padding:.9rem 1rem;overflow:auto;background:var(--panel);font:.8rem/1.5 var(--mono);
 white-space:pre-wrap; overflow-wrap:anywhere}
.colophon{margin-top:3.5rem;padding-top:.7rem;border-top:1px solid var(--rule);font-size:.8rem;color:var(--f-muted)}
@media (min-width:75rem){
 .sheet{grid-template-columns:12rem minmax(0,60rem);gap:3rem}
 .contents{display:block;position:sticky;top:2.5rem;align-self:start;max-height:calc(100vh - 4rem);overflow:auto;
  font-size:.84rem;line-height:1.35}
 .contents p{margin:0 0 .5rem;font-weight:650}
 .contents ol{margin:0;padding:0;list-style:none}.contents li{margin:0;padding:.24rem 0}
 .contents a{display:grid;grid-template-columns:1.6em 1fr;color:var(--f-muted);text-decoration:none}
 .contents a:hover{color:var(--accent);text-decoration:underline}
}
@media screen and (max-width:52rem){.headline{grid-template-columns:repeat(2,minmax(0,1fr))}
 .headline>div,.headline>div:first-child{border-left:0;padding-left:0;border-top:1px solid var(--f-grid)}
 .headline dt{min-height:0}h1{font-size:1.7rem}.kicker{flex-direction:column;gap:.2rem}
 .pairs{grid-template-columns:1fr}.pairs dt{border-bottom:0;padding-bottom:0}figure{overflow-x:auto}
 figure svg{min-width:51rem}}
@media print{
 html{font-size:8.6pt}body{font-size:1rem;line-height:1.42}
 .sheet{display:block;padding:0}.contents,.skip{display:none}
 h1{font-size:1.95rem}h2{margin-top:1.7rem;padding-top:.5rem}
 h2,h3{break-after:avoid}p,li{orphans:3;widows:3}
 figure,.tablewrap.short,.absent,.headline,.verdict,tr,.pairs dt,.pairs dd{break-inside:avoid}
 figure{margin:.9rem 0 1.2rem}figure svg{max-height:235mm}
 .tablewrap{margin:.9rem 0 1.2rem;overflow:visible}thead{display:table-header-group}
 .headline{grid-template-columns:repeat(5,minmax(0,1fr))}
 details>summary{list-style:none}details::details-content{content-visibility:visible;block-size:auto}
 body{background:#fff}
 pre{font-size:.75rem}
 a{color:inherit;text-decoration:none}
}
"""


def page_style(footer: str) -> str:
    """The sheet as CSS text; ``footer`` stands at the foot of printed pages."""
    light = "".join(f"--f-{role}:{tint};" for role, tint in LIGHT.items())
    dark = "".join(f"--f-{role}:{tint};" for role, tint in DARK.items())
    words = footer.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ").replace("<", "\\3c ")
    return (
        f":root{{color-scheme:light dark;{light}--rule:#cdd3da;--panel:#f4f6f8;--accent:#0b5688;--good:#00704f;"
        "--caution:#8a5a00;--bad:#a94400;"
        '--sans:"Source Sans 3","Source Sans Pro",Inter,"Helvetica Neue",Helvetica,Arial,"Liberation Sans",sans-serif;'
        '--mono:ui-monospace,"SF Mono",Menlo,Consolas,"Liberation Mono","DejaVu Sans Mono",monospace}'
        f"@media screen and (prefers-color-scheme:dark){{:root{{{dark}--rule:#38414c;--panel:#1b2027;"
        "--accent:#79bdf2;--good:#4fd3a6;--caution:#f2b73d;--bad:#ff9a62}}"
        "@page{size:A4;margin:15mm 16mm 17mm;"
        f'@bottom-left{{content:"{words}";font:7.5pt sans-serif;color:#5a6574}}'
        '@bottom-right{content:counter(page) " / " counter(pages);font:7.5pt sans-serif;color:#5a6574}}'
        f"{_PAGE}"
    )
