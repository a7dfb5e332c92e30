// The API pages: operations of this service, called in the browser session of the signed-in user.
window.SwaggerUIBundle({
  url: "/api/v1/openapi.json",
  dom_id: "#operations",
  deepLinking: true,
  docExpansion: "list",
  syntaxHighlight: { activated: true },
  validatorUrl: null,
});
