"""JavaScript that looks at a notebook in JupyterLab and runs it.

A server must have ``LabApp.expose_app_in_browser`` set. A notebook's panel is looked for among the
shell's widgets: its ``currentWidget`` is null in a window without the focus, which only one of
several windows has.
"""

from __future__ import annotations

PANEL = """() => {
  for (const widget of window.jupyterapp?.shell?.widgets('main') ?? [])
    if (widget.sessionContext && widget.content?.model?.cells) return widget;
  return null;
}"""
"""The notebook's panel, or null."""
READY = f"""() => {{
  const panel = ({PANEL})();
  return panel?.context.isReady && panel.sessionContext.session?.kernel
    ?.connectionStatus === 'connected';
}}"""
"""Whether the notebook is there and its kernel is connected."""
RUN = "async () => { await window.jupyterapp.commands.execute('notebook:run-all-cells'); }"
ERRORS = f"""() => [...({PANEL})().content.model.cells]
  .filter(cell => cell.type === 'code').flatMap(cell => cell.outputs.toJSON()
    .filter(output => output.output_type === 'error')
    .map(output => ({{cell: cell.getMetadata('tags') ?? [], ...output}})))"""
"""Outputs that are errors, each with the tags of its ``cell``."""
